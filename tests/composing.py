"""The project's configs for tests, each chosen set of files read once a process.

Hydra first merges the files of the chosen groups and then sets the values that follow. Reading
and merging takes a fifth of a second, and most tests choose the same few files: so these are
kept, and a test's own values are set on a copy, in the way that Hydra does it. What is about
composing itself calls Hydra.
"""

from __future__ import annotations

import copy
import functools
import re
from collections.abc import Mapping, Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from qs3.config.compose import composing
from qs3.config.hydra import build
from qs3.config.location import CONF
from qs3.datasets.domain import Domain

_VALUE = re.compile(r"(?!hydra\b)([a-zA-Z_]\w*)(\.\w+)*=")


def by_hydra(command: str | None, words: Sequence[str]) -> DictConfig:
    """What Hydra makes of the words."""
    with composing() as compose:
        return compose(command, list(words))


def compose(command: str | None, words: Sequence[str]) -> DictConfig:
    """The same; a config of the caller's own, which may be changed."""
    values = [word for word in words if _is_value(word)]
    chosen = tuple(word for word in words if not _is_value(word))
    try:
        cfg = copy.deepcopy(_of_files(command, chosen))
        for override in OverridesParser.create().parse_overrides(values):
            if override.is_sweep_override():
                return by_hydra(command, words)
            OmegaConf.update(cfg, override.key_or_group, override.value(), merge=True)
    except OmegaConfBaseException:
        return by_hydra(command, words)  # for its message
    return cfg


def compose_domain(name: str, keys: Mapping[str, str]) -> Domain:
    """What `qs3.datasets.domain.compose_domain` makes of conf/domain/`name`.yaml."""
    words = [f"{k if k.startswith('paths.') else f'domain.{k}'}={v}" for k, v in keys.items()]
    return build(compose(None, [f"+domain={name}", "+paths=default", *words]).domain)


def _is_value(word: str) -> bool:
    """Whether it sets a key that is there, in contrast to choosing, adding and deleting."""
    found = _VALUE.match(word)
    return found is not None and not (found[2] is None and (CONF / found[1]).is_dir())


@functools.cache
def _of_files(command: str | None, chosen: tuple[str, ...]) -> DictConfig:
    return by_hydra(command, chosen)
