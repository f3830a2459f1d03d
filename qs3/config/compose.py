"""Hydra's compose on the project's conf/ in any process, and values as words for it."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qs3.config.location import CONF
from qs3.errors import ConfigError

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
    """The config that a command would run with; ConfigError for a wrong word.

    Args:
        command: "train" or "generate"; None composes the overrides alone (`+sensor=NAME`).
        overrides: words of its command line.
        place: begins the message of an error: "domain=modelnet10: ".
        more: for `hydra.compose`.
    """
    from hydra.errors import HydraException

    with composing() as compose:
        try:
            return compose(command, list(overrides), **more)
        except HydraException as error:
            line = str(error).strip().partition("\n")[0]
            raise ConfigError(f"{place}{line}") from error


def choices(group: str) -> list[str]:
    """Names of the files of a config group, sorted: `choices("domain")`."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def override(key: str, value: str | Path) -> str:
    """`key=value` for a value that is text and nothing else, such as the name of a folder."""
    # OmegaConf's way to say that `${` begins no interpolation; backslashes before it are doubled.
    text = re.sub(r"(\\*)\$\{", lambda found: rf"{found[1]}{found[1]}\${{", str(value))
    return f"{key}={quoted(text)}"


def quoted(text: str) -> str:
    """Text in quotes where Hydra would read something else; an interpolation stays one.

    Unquoted, a comma makes a sweep of a word, brackets a list, and digits a number.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import Quote, QuotedString
    from hydra.errors import HydraException

    try:
        read: Any = OverridesParser.create().parse_override(f"key={text}").value()
    except HydraException:
        read = None
    return text if read == text else QuotedString(text, Quote.single).with_quotes()
