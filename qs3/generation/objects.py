"""Which objects generate.py scans: of the user's folder or of the embedded catalogue."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from qs3.classes import CLASSES, class_list
from qs3.config.hydra import build
from qs3.errors import ConfigError, MissingDataError
from qs3.generation.materials import OwnMaterials
from qs3.meshes.folder import SPLITS, MeshFolder
from qs3.meshes.source import MeshItem

_OWN_MATERIALS = f"{OwnMaterials.__module__}.{OwnMaterials.__name__}"
_ADDED = "catalogue-"  # before the names of objects that fill up the user's
_OTHER_HALF = 1000


def known_classes(cfg: DictConfig) -> tuple[str, ...]:
    """The classes of the domain, in label order."""
    return class_list(cfg.domain.get("classes"))


def mesh_items(cfg: DictConfig) -> list[MeshItem]:
    """The objects to scan, from the user's folder or the embedded catalogue.

    `up` has been decided (`qs3.generation.up_axis`); undecided, it is z.
    """
    if cfg.meshes is None:
        if cfg.up == "y":
            raise ConfigError(
                "up=y is for meshes of yours, and the embedded catalogue has z up: give a folder "
                "with meshes=PATH, or leave it out"
            )
        if own_materials(cfg):
            raise ConfigError(
                "materials=own is for meshes of yours, and the embedded catalogue's have none: "
                "give a folder with meshes=PATH, or take materials=mixed"
            )
        wanted = set(cfg.classes or known_classes(cfg))
        if missing := sorted(wanted - set(CLASSES)):
            raise ConfigError(
                f"the embedded catalogue has no {', '.join(missing)}: give a folder of meshes with "
                "meshes=PATH, or only classes that it has, classes=[chair,table]"
            )
        items = _catalogue_items(cfg)
    else:
        items = _chosen(mesh_folder(cfg).items(), cfg)
    scans = [_scan_of(item, scan) for item in items for scan in range(cfg.scans)]
    names = Counter(item.id for item in scans)
    if same := next((item for item in items if names[item.id] > 1), None):
        raise ConfigError(
            f"{same.path}: with scans={cfg.scans} another mesh's scan is called {same.id!r}, too: "
            "rename the file"
        )
    return _filled_up(scans, cfg) if cfg.fill_up else scans


def _catalogue_items(cfg: DictConfig) -> list[MeshItem]:
    wanted = set(cfg.classes or known_classes(cfg))
    classes = tuple(name for name in CLASSES if name in wanted)
    return _chosen(build(cfg.catalogue, classes=classes, seed=catalogue_seed(cfg)).items(), cfg)


def catalogue_seed(cfg: Any) -> int:
    """Of the other half of meshes, another catalogue: catalogues of two seeds share no mesh."""
    return int(cfg["catalogue"]["seed"]) + (_OTHER_HALF if cfg["half"] == "second" else 0)


def _chosen(items: Sequence[MeshItem], cfg: DictConfig) -> list[MeshItem]:
    """Those of the wanted splits, as many as `limit` and `fraction` say."""
    wanted = [item for item in items if item.split in (cfg.splits or SPLITS)]
    return _first_of_each(wanted, cfg.limit, cfg.fraction)


def _filled_up(own: Sequence[MeshItem], cfg: DictConfig) -> list[MeshItem]:
    """The user's scans, and of each class and split what they lack of the catalogue's number.

    The catalogue's objects have ids of their own: ModelNet's files, too, are called chair_0001.
    """
    lacking = Counter((item.cls, item.split) for item in _catalogue_items(cfg))
    lacking.subtract(Counter((item.cls, item.split) for item in own))
    added = []
    for item in _catalogue_items(cfg):
        if lacking[item.cls, item.split] > 0:
            lacking[item.cls, item.split] -= 1
            folder, stem = item.id.rsplit("/", 1)
            added.append(replace(item, id=f"{folder}/{_ADDED}{stem}"))
    if same := sorted({item.id for item in own} & {item.id for item in added}):
        raise ConfigError(
            f"{same[0]} is what fill_up=true calls an object of the catalogue: rename the file"
        )
    order = {name: k for k, name in enumerate(known_classes(cfg))}
    return sorted([*own, *added], key=lambda item: (order[item.cls], SPLITS.index(item.split)))


def left_alone(cfg: DictConfig) -> list[str]:
    """Folders of other classes beside the user's; see `MeshFolder.left_alone`.

    Raises:
        MissingDataError: the user's folder is there no more.
    """
    try:
        return [] if cfg.meshes is None else mesh_folder(cfg).left_alone()
    except OSError as error:
        raise MissingDataError(
            f"{mesh_root(cfg)} cannot be read any more ({error.strerror}): run the same command "
            "again when it can, what is done is kept"
        ) from error


def mesh_folder(cfg: DictConfig) -> MeshFolder:
    """The user's meshes."""
    return MeshFolder(
        path=mesh_root(cfg),
        classes=tuple(cfg.classes) if cfg.classes else None,
        test_fraction=cfg.test_fraction,
        half=cfg.half,
        known=known_classes(cfg),
        keep_colliders=cfg.colliders == "keep",
        up="y" if cfg.up == "y" else "z",
        optional=CLASSES if cfg.fill_up else (),
        materials=own_materials(cfg),
    )


def own_materials(cfg: DictConfig) -> bool:
    """Whether mesh files are asked what they are made of."""
    return (cfg.get("materials") or {}).get("_target_") == _OWN_MATERIALS


def mesh_root(cfg: DictConfig) -> Path:
    """The user's folder of meshes; absolute, as workers may be in other folders."""
    return Path(cfg.meshes).expanduser().absolute()


def _scan_of(item: MeshItem, scan: int) -> MeshItem:
    """The same mesh under another id, so with other randomness; scan 0 keeps its id."""
    return item if scan == 0 else replace(item, id=f"{item.id}~{scan}")


def _first_of_each(items: Sequence[MeshItem], limit: int | None, fraction: float) -> list[MeshItem]:
    totals = Counter((item.cls, item.split) for item in items)
    seen: Counter[tuple[str, str]] = Counter()
    kept = []
    for item in items:
        group = (item.cls, item.split)
        wanted = math.ceil(fraction * totals[group] - 1e-9)
        if seen[group] < min(wanted, limit or wanted):
            kept.append(item)
        seen[group] += 1
    return kept
