"""The one style of command lines: `qs3 COMMAND key=value`, help at every level, plain errors.

A command declares its options; what is understood, checked and shown by `--help` comes from that
declaration. Declaring is light: a command imports what it works with when it runs.
"""

from __future__ import annotations

import functools
import os
import re
import shlex
import signal
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from qs3.errors import ConfigError, Qs3Error
from qs3.utils.hints import hint_of, missing_of, nearest
from qs3.utils.threads import let_waiting_threads_sleep
from qs3.utils.version import VERSION

# Exit status, as shells say it.
INTERRUPTED, BROKEN_PIPE = 128 + signal.SIGINT, 128 + signal.SIGPIPE
TERMINATED = 128 + signal.SIGTERM
_HELP = ("-h", "--help")
_WIDTH = 100
_PLACES = {"FILE", "FOLDER", "PATH", "RUN"}
# Flags of Hydra that show something and end.
_SHOWS = (*_HELP, "--hydra-help", "--version", "--cfg", "-c", "--info", "-i", "-sc")


class Kind(NamedTuple):
    """What a value looks like.

    Attributes:
        word: stands for it in the help.
        read: the value of a text; ValueError if there is none.
        must: what it has to be, for messages.
    """

    word: str
    read: Callable[[str], Any]
    must: str = "text"


def text(word: str = "TEXT") -> Kind:
    """Anything; `word` stands for it in the help.

    Of a FILE, FOLDER, PATH or RUN ~/ is the home folder. Bash writes it out behind `=`, and other
    shells leave it.
    """
    return Kind(word, _from_home if _PLACES.intersection(word.split("|")) else str)


def _from_home(words: str) -> str:
    found = os.path.expanduser(words)
    # A file called ~scan.xyz is nobody's home, and `Path.expanduser` would stop at it.
    return os.path.abspath(words) if found == words and words.startswith("~") else found


def path(word: str = "PATH") -> Kind:
    """A file or folder; ~ is the home folder."""
    return Kind(word, lambda words: Path(_from_home(words)), "a path")


def whole(least: int = 1) -> Kind:
    """A whole number from `least` on."""

    def read(words: str) -> int:
        if (number := int(words)) < least:
            raise ValueError
        return number

    return Kind("N", read, f"a whole number of at least {least}")


NUMBER = Kind("NUMBER", float, "a number")


def one_of(*choices: str) -> Kind:
    """One of few words."""
    return Kind("|".join(choices), lambda word: choices[choices.index(word)], " or ".join(choices))


FLAG = Kind(
    "true|false", lambda word: ("false", "true").index(word.casefold()) == 1, "true or false"
)


def several(kind: Kind) -> Kind:
    """Values between commas, also in brackets as in a config."""

    def read(words: str) -> tuple[Any, ...]:
        parts = [word.strip() for word in words.removeprefix("[").removesuffix("]").split(",")]
        return tuple(kind.read(word) for word in parts if word)

    return Kind(f"{kind.word},...", read, f"{kind.must}, or several between commas")


@dataclass(frozen=True)
class Option:
    """A key that a command understands.

    Attributes:
        key: what stands before the "=".
        kind: of its value.
        help: one sentence or two.
        default: if it is not given; the help shows it unless it is None, empty or false.
        required: it has to be given.
        choices: values that there are, for help and messages.
    """

    key: str
    kind: Kind
    help: str
    default: Any = None
    required: bool = False
    choices: Callable[[], Iterable[str]] = tuple

    def read(self, words: str) -> Any:
        """The value of a text; ConfigError if it has none."""
        try:
            if words:
                return self.kind.read(words)
        except ValueError:
            pass
        without = "" if words or self.required else f"; for the default leave {self.key}= out"
        raise ConfigError(f"{self.key} must be {self.kind.must}, got {words!r}{without}")

    def explained(self) -> str:
        """For the help: what it means, its default and its choices."""
        value = self.default
        shown = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
        notes = ["required"] * self.required
        notes += [f"default {'true' if value is True else shown}"] * (
            value not in (None, "", False, ())
        )
        choices = f"; one of {', '.join(self.choices())}" if self.choices is not tuple else ""
        return self.help + choices + (f" ({', '.join(notes)})" if notes else "")


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        name: as it is typed: "qs3 predict".
        summary: what it does, in a line.
        run: gets the value of each option by its key; its return value is the exit status, None
            is 0.
        options: in the order of the help.
        examples: lines to type.
        about: paragraphs below the options.
        words: what words without "=" stand for, such as "A B"; `run` gets them as `words`.
        bare: instead of these, the key that one word without "=" gives the value of.
        others: beginnings of keys that are handed on, with their help; "" for any key. `run` gets
            these key=value words as `more`.
        line: `run` also gets the line that was typed as `line`, to record it.
        interrupted: what to say after Ctrl-C.
    """

    name: str
    summary: str
    run: Callable[..., int | None]
    options: Sequence[Option]
    examples: Sequence[str]
    about: str = ""
    words: str = ""
    bare: str = ""
    others: Mapping[str, str] = field(default_factory=dict)
    line: bool = False
    interrupted: str = "run the same command again and it continues"

    def __call__(self, argv: Sequence[str]) -> int:
        """Show help or run; returns the exit status."""
        if argv[:1] == ["help"] or {*_HELP} & {*argv}:
            print(self.help())
            return 0
        try:
            return self.run(**self.parse(argv)) or 0
        except KeyboardInterrupt:
            print(f"\ninterrupted; {self.interrupted}", file=sys.stderr)
            return INTERRUPTED

    def parse(self, argv: Sequence[str]) -> dict[str, Any]:
        """The arguments of `run`.

        Raises:
            ConfigError: a key that is unknown, missing or given twice; a value of the wrong kind.
        """
        known = {option.key: option for option in self.options}
        given: dict[str, Any] = {}
        words, more = [], []
        for word in argv:
            key, equals, value = word.partition("=")
            if self.bare and not equals and not word.startswith("-"):
                key, equals, value = self.bare, "=", word
                if key in given:
                    raise ConfigError(self._one(known[key], word))
            option = known.get(key) or known.get(key.removeprefix("paths."))
            if not equals and self.words:
                words.append(_from_home(word))
            elif equals and option:
                if option.key in given:
                    raise ConfigError(f"{option.key}= is given twice")
                given[option.key] = option.read(value)
            elif equals and key.startswith((*self.others,)):
                more.append(word)
            else:
                raise ConfigError(self._unknown(word, key if equals else ""))
        missing = [o for o in self.options if o.required and o.key not in given]
        if missing:
            raise ConfigError(self._missing(missing, [word.split("=")[0] for word in more]))
        given = {option.key: option.default for option in self.options} | given
        extra: dict[str, Any] = {"words": words} if self.words else {}
        extra |= {"more": more} if self.others else {}
        extra |= {"line": f"{self.name} {shlex.join(argv)}"} if self.line else {}
        return given | extra

    def _one(self, option: Option, word: str) -> str:
        folder = "; of several files give the folder" if option.kind.word == "PATH" else ""
        what = f"one {option.kind.word.replace('|', ' or ')} is enough, and {word} is another"
        return f"{what}{folder} (see {self.name} --help)"

    def _unknown(self, word: str, key: str) -> str:
        known = [*(option.key for option in self.options), *self.others]
        what = f"unknown key {key!r}" if key else f"{word!r} is not key=value"
        near = nearest(key, known)
        hint = f"did you mean {near}=?" if near else f"keys are {', '.join(known)}"
        return f"{what}; {hint} (see {self.name} --help)"

    def _missing(self, options: Sequence[Option], given: Sequence[str]) -> str:
        keys = ", ".join(f"{option.key}={option.kind.word}" for option in options)
        near = [f"; not {nearest(o.key, given)}=" for o in options if nearest(o.key, given)]
        choices = [f": one of {', '.join(o.choices())}" for o in options if o.choices is not tuple]
        first = "\n".join(self.examples).replace("\\\n", "").partition("\n")[0]
        hint = "".join(near or choices) or f"; for example: {' '.join(first.split())}"
        return f"{keys} is missing{hint} (see {self.name} --help)"

    def help(self) -> str:
        """What `--help` prints."""
        rows = [(f"{o.key}={o.kind.word}", o.explained()) for o in self.options]
        rows += [(f"{prefix}KEY=VALUE", meaning) for prefix, meaning in self.others.items()]
        words = [self.words] if self.words else []
        words += [option.kind.word for option in self.options if option.key == self.bare]
        name = " ".join([self.name, *words])
        return _page(name, self.summary, self.examples, rows, self.about)


@dataclass(frozen=True)
class Group:
    """Commands below a word, and `--version`.

    Attributes:
        name: as it is typed: "qs3 report".
        summary: what they are for, in a line.
        commands: by their word, each a Command, a Group, or where one is: "module:NAME".
        examples: lines to type.
        default: the command that is meant when a key=value follows.
        about: a paragraph below the list.
    """

    name: str
    summary: str
    commands: Mapping[str, Command | Group | str]
    examples: Sequence[str]
    default: str = ""
    about: str = ""

    def __call__(self, argv: Sequence[str]) -> int:
        """Show the list of commands, or hand on to one of them."""
        first, *rest = argv or ["help"]
        if first == "help" and rest:
            first, *rest = *rest, "--help"
        if first in self.commands:
            return self.command(first)(rest)
        if first in (*_HELP, "help"):
            print(self.help())
            return 0
        if first in ("--version", "version"):
            print(f"qs3 {VERSION}")
            return 0
        if self.default and "=" in first:
            return self.command(self.default)(argv)
        near = nearest(first, self.commands)
        raise ConfigError(
            f"unknown command {first!r}; "
            + (f"did you mean {near}?" if near else f"there are {', '.join(self.commands)}")
            + f" (see {self.name} --help)"
        )

    def command(self, word: str) -> Command | Group:
        """The command of a word, imported."""
        found = self.commands[word]
        if isinstance(found, str):
            module, _, name = found.partition(":")
            command: Command | Group = getattr(import_module(module), name)
            return command
        return found

    def help(self) -> str:
        """What `--help` prints: a line for each command."""
        rows = [(word, self.command(word).summary) for word in self.commands]
        return _page(f"{self.name} COMMAND", self.summary, self.examples, rows, self.about)


def run(command: Command | Group, argv: Sequence[str]) -> int:
    """Run a command as a process does; returns the exit status.

    An error meant for people is one line on stderr and status 1; a reader that has seen enough
    (`| head`) ends it quietly.
    """
    let_waiting_threads_sleep()
    try:
        status = command(argv)
        sys.stdout.flush()
    except Qs3Error as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
        return BROKEN_PIPE
    return status


def hydra_command(main: Callable[[], Any]) -> Callable[[], None]:
    """`main` of Hydra with the same manners: `help`, hints, Ctrl-C, SIGTERM, `--help | head`."""

    @functools.wraps(main)
    def command() -> None:
        if sys.argv[1:] == ["help"]:
            sys.argv[1] = "--help"
        if any(word.split("=")[0] in _SHOWS for word in sys.argv[1:]):
            signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        signal.signal(signal.SIGTERM, _terminate)
        if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # the terminal is gone; not nohup's
            signal.signal(signal.SIGHUP, _terminate)
        let_waiting_threads_sleep()
        try:
            main()
        except (KeyboardInterrupt, SystemExit) as error:
            if isinstance(error, SystemExit) and error.code == TERMINATED:
                what, status = "terminated", TERMINATED
            elif isinstance(error, KeyboardInterrupt) or isinstance(
                error.__context__,
                KeyboardInterrupt,  # Lightning's way to end
            ):
                what, status = "interrupted", INTERRUPTED
            else:
                if hint := hint_of(error.__context__, sys.argv):  # Hydra's own error, told
                    print(hint, file=sys.stderr)
                raise
            print(f"\n{what}; run the same command again and it continues", file=sys.stderr)
            sys.exit(status)
        except Exception as error:  # of Hydra's own keys, as the folder of a run; others it tells
            if not (told := missing_of(error, sys.argv[1:])):
                raise
            print(told, file=sys.stderr)
            sys.exit(1)

    return command


def _terminate(number: int, frame: FrameType | None) -> None:
    """End as after Ctrl-C, with all that is to be put away; a second SIGTERM ends at once."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    raise SystemExit(TERMINATED)


def _page(
    name: str, summary: str, examples: Sequence[str], rows: Sequence[tuple[str, str]], about: str
) -> str:
    column = min(max(len(left) for left, _ in rows), 24) + 4
    lines = [f"{name}: {summary}", "", *(f"    {example}" for example in examples), ""]
    for left, right in rows:
        begin = (
            f"  {left}".ljust(column) if len(left) + 4 <= column else f"  {left}\n{' ' * column}"
        )
        # A long list without spaces is broken behind its commas, and nowhere else.
        spaced = re.sub(r"\S{40,}", lambda word: word[0].replace(",", ",\0 "), right)
        wrapped = [
            line.replace("\0 ", "").rstrip("\0") for line in textwrap.wrap(spaced, _WIDTH - column)
        ]
        lines.append(begin + f"\n{' ' * column}".join(wrapped))
    return "\n".join([*lines, *(["", about.strip("\n")] if about else [])])
