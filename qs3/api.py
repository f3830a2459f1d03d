"""The commands as functions, for notebooks: the words are those of the command line.

import qs3

qs3.generate("domain=modelnet10", "limit=5", "paths.data_dir=data")
scan = qs3.generate(trimesh.load("chair.glb"), "domain=specklenet10", "renderer=mitsuba")
folder = qs3.train("experiment=quickstart", "seed=1", "paths.data_dir=data")
predictor = qs3.load(folder)
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

if TYPE_CHECKING:
    import torch
    from omegaconf import DictConfig

    from qs3.generation.scan import Scan, Solid
    from qs3.inference.predictor import Predictor
    from qs3.store.store import PointSet


def train(*overrides: str) -> Path:
    """Train a run as `python train.py <overrides>` does, in this process.

    A finished run is not trained again. One seed at a time: there is no `-m` here.

    Returns:
        The run's folder; `qs3.report.run_files.read_run` and `qs3.load` read it.

    Raises:
        ConfigError, MissingDataError, ...: as the command says them.
    """
    from omegaconf import OmegaConf

    from qs3.errors import ConfigError
    from qs3.runs.folder import removed_if_unbegun
    from qs3.training.command import train as trained
    from qs3.training.run import run_of
    from qs3.utils.files import write_text

    if any(word.lstrip("+").startswith("hparams_search=") for word in overrides):
        raise ConfigError("hparams_search= is many runs: search with python train.py, or qs3-train")
    with _as_hydra("train", overrides) as cfg:
        folder = run_of(cfg).folder
        with removed_if_unbegun(folder):
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
    (trimesh leaves glTF files so). A scene's invisible collision nodes, such as `table_collider`,
    are left out as those of files are, unless the words have "colliders=keep". Everything happens
    in this process, and nothing is written. An object's bytes depend on the seed and on its id:
    the key of a dict, "object" for a single mesh, "0", "1", ... in a list. With the id of a
    dataset's object they are those of the dataset. What chooses among a dataset's objects (limit,
    fraction, splits, scans) is refused.

    Returns:
        Of words the dataset; of a mesh a `qs3.generation.scan.Scan`; of a list or dict one each.

    Raises:
        ConfigError: a setting is wrong.
        MeshError, DataError: a mesh is empty or gives too few points; names its id.
        RenderError: the renderer cannot be used here.
    """
    of_meshes = bool(arguments) and not isinstance(arguments[0], str)
    if not of_meshes:
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


def load(
    run: str | Path,
    *,
    device: str | torch.device = "cpu",
    packages: Sequence[str] = ("qs3.models",),
    prior: str | Mapping[str, float] | None = None,
    prior_power: float = 0.5,
) -> Predictor:
    """The classifier that a finished run reports.

        predictor = qs3.load("logs/qs3_s2d/seed0-1a2b3c4d")
        probabilities = predictor([cloud_a, cloud_b])  # [2, classes] float64
        predictor.classes  # their names, in that order
        found = predictor.predict_depth(depth_m, (fx, fy, cx, cy), mask=mask)  # or box=, up=

    A cloud is an [n, 3] array of x y z with any n, any size and place, z up (or `up=`). One that
    knows sizes and heights, as "dgcnn-rooms" (`predictor.needs_floor`), takes metres and needs the
    floor: `predictor(clouds, floor=0.0)`, `predictor.predict_depth(..., camera_height=1.2)`.

    Args:
        run: its folder, or the file result.pt of it, which needs nothing beside it; or a folder
            that `qs3 export out=FOLDER` wrote; or the name of a classifier that comes with qs3,
            "dgcnn-speckle".
        device: where to run it: "cpu", "cuda", "cuda:1".
        packages: where the net of the file may be defined. For a net of your own add your
            package, if you trust it to be built with any arguments.
        prior: how common classes are where the clouds come from: "rooms", as in ScanNet's, or
            {"chair": 4, "bathtub": 0}, where those not named count as 1; None: as in training.
        prior_power: how much of that is believed: 0 nothing, 1 all (`qs3.evaluation.prior`).

    Returns:
        See `qs3.inference.predictor.Predictor`.

    Raises:
        qs3.errors.MissingDataError: no finished run there.
        qs3.errors.DataError: the file is damaged, or asks for something else than a net of
            `packages`.
        qs3.errors.ConfigError: no such device, or no such prior.
    """
    from qs3.inference.predictor import load as load_result

    return load_result(run, device=device, packages=packages, prior=prior, prior_power=prior_power)


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
