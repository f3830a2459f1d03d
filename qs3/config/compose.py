"""Hydra's compose on the project's conf/, in any process and inside a Hydra application too."""

from __future__ import annotations

import contextlib
import functools
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from qs3.config.location import CONF
from qs3.errors import ConfigError
from qs3.utils.hints import hint_of

_ONE_RUN = "one run at a time: call it once for each seed"
_NO_NAME = re.compile(r"null|true|false|[-+]?[\d_.]+", re.IGNORECASE)  # to Hydra

if TYPE_CHECKING:
    from omegaconf import DictConfig


@contextlib.contextmanager
def composing() -> Iterator[Callable[..., Any]]:
    """`hydra.compose` for the block; a running application's state is put back after it."""
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.utils import JobRuntime
    from hydra.version import VersionBase

    import qs3.config.hydra  # noqa: F401  registers the resolvers that the configs use

    outer, version, job = GlobalHydra.instance(), VersionBase.instance(), JobRuntime.instance()
    running, base, name = outer.hydra, version.version_base, job.get("name")
    outer.clear()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            yield compose
    finally:
        outer.hydra, version.version_base = running, base
        GlobalHydra.set_instance(outer)
        job.set("name", name)


def composed(command: str | None, *overrides: str, place: str = "", **more: Any) -> DictConfig:
    """The config that a command would run with.

    Args:
        command: "train" or "generate"; None composes the overrides alone (`+sensor=NAME`).
        overrides: words of its command line.
        place: begins the message of an error: "domain=modelnet10: ".
        more: for `hydra.compose`.

    Raises:
        ConfigError: no such group, choice or key.
    """
    from hydra.errors import HydraException

    from qs3.config.quoting import as_text

    check_choices(overrides)
    with composing() as compose:
        try:
            return compose(command, [as_text(word) for word in overrides], **more)
        except HydraException as error:
            raise ConfigError(f"{place}{explained(error, command, overrides)}") from error


def choices(group: str) -> list[str]:
    """Names of the files of a config group, sorted: `choices("domain")`."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def check_choices(words: Sequence[str]) -> None:
    """Raise ConfigError for the first word whose value can name no file: logger=null, model=3."""
    for word in words:
        key, _, value = word.partition("=")
        group = key.lstrip("+").partition("@")[0]
        ours = (CONF / group).is_dir() and group and not group.startswith("hydra/")
        if ours and _NO_NAME.fullmatch(value):
            raise ConfigError(
                f"{word}: {group} is chosen by the name of a file; there are "
                f"{', '.join(choices(group))}; or leave {word} out"
            )


def choices_checked(main: Callable[[], Any]) -> Callable[[], None]:
    """A Hydra command that ends with what `check_choices` says, where Hydra has a traceback.

    Words that are plain text to people reach Hydra as text, see `as_text`.
    """

    @functools.wraps(main)
    def command() -> None:
        from qs3.config.quoting import as_text

        try:
            check_choices(sys.argv[1:])
        except ConfigError as error:
            sys.exit(f"{type(error).__name__}: {error}")
        sys.argv[1:] = [as_text(word) for word in sys.argv[1:]]
        main()

    return command


def explained(error: BaseException, command: str | None, words: Sequence[str]) -> str:
    """Hydra's message in one line, and what to write instead where that is known."""
    line = first_line(error)
    word = getattr(error, "override", None)  # of Hydra's OverrideParseException
    if isinstance(word, str):
        advice = _of_word(word, command)
        return f"{word!r} cannot be read: {advice or line}"
    if line.startswith("Ambiguous value"):  # seed=0,1
        return f"{line}: a list is written key=[a,b]; {_ONE_RUN}"
    hint = hint_of(error, words)
    if options := getattr(error, "options", None):  # of Hydra's MissingConfigException
        hint = hint or f"there are {', '.join(options)}"
    return f"{line.rstrip('.')}; {hint}" if hint else line


def _of_word(word: str, command: str | None) -> str:
    """What is wrong with a word that Hydra cannot parse; "" if its own message has to do."""
    if word.startswith("-"):
        return f"flags are for the command line; {_ONE_RUN}"
    if "=" not in word:
        mesh = "; a mesh is given as trimesh.load(path)" if command == "generate" else ""
        return f"words are key=value{mesh}"
    if len(parts := word.split()) > 1 and all("=" in part for part in parts):
        return f"one key=value each: {', '.join(map(repr, parts))}"
    return ""


def first_line(error: BaseException) -> str:
    """The first line of an error's message; its kind if it has none."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
