"""Training and generation as functions, for notebooks: the words are those of the command line.

qs3.generate("domain=modelnet10", "limit=5", "paths.data_dir=data")
scan = qs3.generate(trimesh.load("chair.glb"), "domain=specklenet10")
folder = qs3.train("experiment=quickstart", "seed=1", "paths.data_dir=data")
predictor = qs3.load(folder)
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from qs3.generation.scan import Scan, Solid
    from qs3.store.store import PointSet


def train(*overrides: str) -> Path:
    """Train a run as `python train.py <overrides>` does, in this process; returns its folder.

    `qs3.report.run_page.read_run` and `qs3.load` read it. A finished run is not trained again. One
    seed at a time: `-m` does not exist here. Errors are those of the command.
    """
    from omegaconf import OmegaConf

    from qs3.errors import ConfigError
    from qs3.training.command import train as trained
    from qs3.training.run import run_of
    from qs3.utils.files import write_text

    if any(word.lstrip("+").startswith("hparams_search=") for word in overrides):
        raise ConfigError("hparams_search= is many runs: search with python train.py, or qs3-train")
    with _as_hydra("train", overrides) as cfg:
        folder = run_of(cfg).folder
        trained(cfg)
    # What Hydra leaves in a run's folder, which pictures and `qs3.report` read.
    write_text(folder / ".hydra" / "config.yaml", OmegaConf.to_yaml(cfg))
    write_text(folder / ".hydra" / "overrides.yaml", OmegaConf.to_yaml(list(overrides)))
    return folder


@overload
def generate(*overrides: str) -> PointSet: ...
@overload
def generate(meshes: Solid, /, *overrides: str) -> Scan: ...
@overload
def generate(meshes: Sequence[Solid], /, *overrides: str) -> list[Scan]: ...
@overload
def generate(meshes: Mapping[str, Solid], /, *overrides: str) -> dict[str, Scan]: ...
def generate(*arguments: Any) -> Any:
    """Make a dataset as `python generate.py <overrides>` does, or scan meshes from memory.

        qs3.generate("domain=modelnet10", "limit=5")                     # a dataset on disk
        scan = qs3.generate(mesh, "domain=specklenet10", "views=3")      # one mesh, from memory
        scan.points, scan.clean                                          # [2048, 3] float32 each

    A dataset: workers are processes of their own; workers=0 uses this one.

    Meshes: first one `trimesh.Trimesh`, `trimesh.Scene` or `qs3.meshes.mesh.Mesh`, or a list or a
    dict of them, then the words. They are metres with z up, as they stand, or with "up=y" y up
    (trimesh leaves glTF files so). Everything happens in this process, and nothing is written. An
    object's bytes depend on the seed and on its id: the key of a dict, "object" for a single mesh,
    "0", "1", ... in a list. With the id of a dataset's object they are those of the dataset.

    Returns:
        Of words the dataset; of a mesh a `qs3.generation.scan.Scan`; of a list or dict one each.
    """
    if not arguments or isinstance(arguments[0], str):
        from qs3.generation.command import generate as made

        with _as_hydra("generate", arguments) as cfg:
            return made(cfg)
    from qs3.generation.scan import scan_meshes

    solids, *overrides = arguments
    if isinstance(solids, Mapping):
        return scan_meshes(solids, overrides)
    if isinstance(solids, list | tuple):
        named = {str(number): solid for number, solid in enumerate(solids)}
        return list(scan_meshes(named, overrides).values())
    return scan_meshes({"object": solids}, overrides)["object"]


@contextlib.contextmanager
def _as_hydra(command: str, overrides: Sequence[str]) -> Iterator[DictConfig]:
    """A command's config; in the block Hydra's choices are known, which name parts."""
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import open_dict

    from qs3.config.compose import composed

    whole = composed(command, *overrides, return_hydra_config=True)
    known, before = HydraConfig.instance(), HydraConfig.instance().cfg
    known.set_config(whole)
    cfg = whole.copy()
    with open_dict(cfg):
        del cfg["hydra"]
    try:
        yield cfg
    finally:
        known.cfg = before
