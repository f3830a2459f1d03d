"""The command line: `qs3 COMMAND key=value`; a typed function is the only declaration of a command.

    def sample(
        input: Annotated[Path, "clouds: a file or a folder"],
        *,
        points: Annotated[int, Ge(1), "points of each cloud"] = 1024,
        **overrides: Annotated[str, "settings of the domain's config"],
    ) -> None:
        \"\"\"Draw clouds at random.\"\"\"

Parameters before the `*` also take words without "="; `*words` takes any number of them, and
`**overrides` any other key. Types and bounds (`annotated_types`) are checked by pydantic, which is
imported only when a command runs or shows its help.
"""

import functools
import inspect
import os
import signal
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from inspect import Parameter
from pathlib import Path
from pkgutil import resolve_name
from types import FrameType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from qs3.errors import ConfigError, Qs3Error
from qs3.utils.processor import let_waiting_threads_sleep
from qs3.utils.version import VERSION

INTERRUPTED, BROKEN_PIPE = 128 + signal.SIGINT, 128 + signal.SIGPIPE
TERMINATED = 128 + signal.SIGTERM
_HELP = ("-h", "--help")
_WIDTH = 100
_AGAIN = "ended; run the same command again and it continues"
_WORDS = {int: "N", float: "NUMBER", bool: "true|false", Path: "PATH", str: "TEXT"}

Commands = Mapping[str, "str | Commands"]
"""Commands by their words: "module:function", or a mapping of further words. Under "" stands the
command that is meant when a key=value follows."""


def run(commands: Commands, argv: Sequence[str], name: str = "qs3", about: str = "") -> int:
    """Run a command as a process does; a `Qs3Error` is a line on stderr and exit status 1."""
    let_waiting_threads_sleep()
    try:
        status = _dispatch(commands, list(argv), name, about)
        sys.stdout.flush()
    except Qs3Error as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"\n{_AGAIN}", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        _forget_output()
        return BROKEN_PIPE
    return status


def _dispatch(commands: Commands, argv: list[str], name: str, about: str) -> int:
    first, *rest = argv or ["--help"]
    if first == "--version":
        print(f"qs3 {VERSION}")
        return 0
    if first in _HELP:
        rows = [(word, _summary(found)) for word, found in commands.items() if word]
        print(_page(f"{name} COMMAND", about, rows))
        return 0
    if first in commands:
        found, name = commands[first], f"{name} {first}"
    elif "" in commands and "=" in first:
        found, rest = commands[""], argv
    else:
        known = ", ".join(filter(None, commands))
        raise ConfigError(f"unknown command {first!r}; there are {known}")
    if not isinstance(found, str):
        return _dispatch(found, rest, name, "")
    function = resolve_name(found)
    if {*_HELP} & {*rest}:
        print(_help(function, name))
        return 0
    words, given = parse(function, rest)
    return function(*words, **given) or 0


def parse(function: Callable[..., Any], argv: Sequence[str]) -> tuple[list[Any], dict[str, Any]]:
    """The positional arguments and the others that words of a command line stand for.

    Raises:
        ConfigError: a key that is unknown, missing or given twice; a value of the wrong type.
    """
    from pydantic import ConfigDict, ValidationError, validate_call

    from qs3.utils.settings import problems

    hints = get_type_hints(function, include_extras=True)
    kinds = {name: p.kind for name, p in inspect.signature(function).parameters.items()}
    bare = [name for name, kind in kinds.items() if kind is Parameter.POSITIONAL_OR_KEYWORD]
    fields = [*bare, *(name for name, kind in kinds.items() if kind is Parameter.KEYWORD_ONLY)]
    given: dict[str, Any] = {}
    words: list[str] = []
    for word in argv:
        key, equals, value = word.partition("=")
        key = key.removeprefix("paths.") if key.removeprefix("paths.") in fields else key
        free = next((name for name in bare if name not in given), None)
        if not equals and free and not word.startswith("-"):
            key, equals, value = free, "=", word
        if equals and key in given:
            raise ConfigError(f"{key}= is given twice")
        if equals and (key in fields or Parameter.VAR_KEYWORD in kinds.values()):
            given[key] = _split(value, hints[key]) if key in fields else value
        elif not equals and not free and Parameter.VAR_POSITIONAL in kinds.values():
            words.append(word)
        else:
            raise ConfigError(f"unknown key {key!r}; there are {', '.join(fields)}")

    @functools.wraps(function)
    def read(*words: Any, **given: Any) -> tuple[list[Any], dict[str, Any]]:
        return [_home(word) for word in words], {key: _home(v) for key, v in given.items()}

    first = [given.pop(name) for name in bare] if words else []
    try:
        checked: Any = validate_call(config=ConfigDict(allow_inf_nan=False))(read)
        return checked(*first, *words, **given)
    except ValidationError as error:
        raise ConfigError(problems(error)) from None


def _home(value: Any) -> Any:
    return value.expanduser() if isinstance(value, Path) else value


def hydra_command(main: Callable[[], Any]) -> Callable[[], None]:
    """`main` of Hydra with the same manners: Ctrl-C and SIGTERM end with their exit status."""

    def command() -> None:
        signal.signal(signal.SIGTERM, _terminate)
        if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # the terminal is gone; not nohup's
            signal.signal(signal.SIGHUP, _terminate)
        let_waiting_threads_sleep()
        try:
            main()
        except BrokenPipeError:
            _forget_output()
            sys.exit(BROKEN_PIPE)
        except (KeyboardInterrupt, SystemExit) as error:
            status = INTERRUPTED
            if isinstance(error, SystemExit) and error.code == TERMINATED:
                status = TERMINATED
            elif not any(isinstance(e, KeyboardInterrupt) for e in (error, error.__context__)):
                raise  # the second is Lightning's way to end
            print(f"\n{_AGAIN}", file=sys.stderr)
            sys.exit(status)

    return command


def _forget_output() -> None:
    """Let the flush at exit go nowhere: the reader of the pipe has gone."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _terminate(number: int, frame: FrameType | None) -> None:
    """End as after Ctrl-C, with all that is to be put away; a second SIGTERM ends at once."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    raise SystemExit(TERMINATED)


def _summary(found: str | Commands) -> str:
    if not isinstance(found, str):
        return f"one of {', '.join(filter(None, found))}"
    return (inspect.getdoc(resolve_name(found)) or "").partition("\n")[0].rstrip(".")


def _split(value: str, hint: Any) -> Any:
    """A list of the words between commas where the type is a tuple."""
    if value == "null":
        return None
    if tuple not in [get_origin(kind) for kind in _kinds(hint)]:
        return value
    return [part.strip() for part in value.strip("[]").split(",") if part.strip()]


def _kinds(hint: Any) -> list[Any]:
    """The types that a hint allows, without Annotated and None."""
    if get_origin(hint) is Annotated:
        return _kinds(get_args(hint)[0])
    if get_origin(hint) in (Union, UnionType):
        return [kind for one in get_args(hint) for kind in _kinds(one)]
    return [] if hint is type(None) else [hint]


def _word(hint: Any) -> str:
    """What stands for a value of this type in the help."""
    words = []
    for kind in _kinds(hint):
        if get_origin(kind) is Literal:
            words.append("|".join(map(str, get_args(kind))))
        elif get_origin(kind) is tuple:
            words.append(f"{_word(get_args(kind)[0])},...")
        else:
            words.append(_WORDS.get(kind, "TEXT"))
    return "|".join(dict.fromkeys(words))


def _help(function: Callable[..., Any], name: str) -> str:
    hints = get_type_hints(function, include_extras=True)
    rows, bare = [], []
    for key, p in inspect.signature(function).parameters.items():
        hint = hints[key]
        says = " ".join(m for m in getattr(hint, "__metadata__", ()) if isinstance(m, str))
        if p.kind is p.VAR_POSITIONAL:
            bare.append(f"[{key.upper()} ...]")
            continue
        if p.kind is p.VAR_KEYWORD:
            rows.append(("KEY=VALUE", says))
            continue
        if p.kind is p.POSITIONAL_OR_KEYWORD:
            bare.append(key.upper() if p.default is p.empty else f"[{key.upper()}]")
        if p.default is p.empty:
            says += " (required)"
        elif p.default not in (None, "", False, ()):
            shown = p.default if not isinstance(p.default, tuple) else ",".join(p.default)
            says += f" (default {str(shown).lower() if shown is True else shown})"
        rows.append((f"{key}={_word(hint)}", says))
    summary, _, about = (inspect.getdoc(function) or "").partition("\n")
    return _page(" ".join([name, *bare]), summary.rstrip("."), rows, about.strip("\n"))


def _page(name: str, summary: str, rows: Sequence[tuple[str, str]], about: str = "") -> str:
    column = min(max((len(left) for left, _ in rows), default=0), 24) + 4
    lines = [f"{name}: {summary}" if summary else name, ""]
    for left, right in rows:
        begin, indent = f"  {left}  ".ljust(column), " " * column
        lines.append(textwrap.fill(right, _WIDTH, initial_indent=begin, subsequent_indent=indent))
    return "\n".join([*lines, *(["", about] if about else [])])
