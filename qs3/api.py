"""train.py and generate.py as functions, for notebooks: the words are those of the command line.

from qs3.api import generate, train

generate("domain=modelnet10", "limit=5", "paths.data_dir=data")
folder = train("experiment=quickstart", "seed=1", "paths.data_dir=data")
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from qs3.data.store import PointSet


def train(*overrides: str) -> Path:
    """Train a run as `python train.py <overrides>` does, in this process.

    A finished run is not trained again. One seed at a time: there is no `-m` here.

    Returns:
        The run's folder; `qs3.report.runs.data.read_run` and `qs3.load` read it.

    Raises:
        ConfigError, MissingDataError, ...: as the command says them.
    """
    from omegaconf import OmegaConf

    from qs3.runs.folder import run_folder
    from qs3.training.command import train as run_of
    from qs3.utils.files import write_text

    with _as_hydra("train", overrides) as cfg:
        folder = run_folder(cfg)
        run_of(cfg)
    # What Hydra leaves in a run's folder, which pictures and `qs3.report` read.
    write_text(folder / ".hydra" / "config.yaml", OmegaConf.to_yaml(cfg))
    write_text(folder / ".hydra" / "overrides.yaml", OmegaConf.to_yaml(list(overrides)))
    return folder


def generate(*overrides: str) -> PointSet:
    """Make a dataset as `python generate.py <overrides>` does; see there.

    Workers are processes of their own; workers=0 uses this one.
    """
    from qs3.generation.command import generate as made

    return made(composed("generate", *overrides))


@contextlib.contextmanager
def _as_hydra(command: str, overrides: Sequence[str]) -> Iterator[DictConfig]:
    """A command's config; in the block Hydra's choices are known, which name a run's parts."""
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import open_dict

    whole = _composed(command, overrides, return_hydra_config=True)
    known, before = HydraConfig.instance(), HydraConfig.instance().cfg
    known.set_config(whole)
    cfg = whole.copy()
    with open_dict(cfg):
        del cfg["hydra"]
    try:
        yield cfg
    finally:
        known.cfg = before


def composed(command: str, *overrides: str) -> DictConfig:
    """The config that a command would run with.

    Args:
        command: "train" or "generate".
        overrides: words of its command line.

    Raises:
        ConfigError: no such group, choice or key.
    """
    return _composed(command, overrides)


def _composed(command: str, overrides: Sequence[str], **more: Any) -> Any:
    from hydra.errors import ConfigCompositionException, OverrideParseException

    from qs3.errors import ConfigError
    from qs3.report.tables.table import composing

    with composing() as compose:
        try:
            return compose(command, list(overrides), **more)
        except (ConfigCompositionException, OverrideParseException) as error:
            lines = str(error).strip().splitlines()
            raise ConfigError(lines[0] if lines else type(error).__name__) from error
