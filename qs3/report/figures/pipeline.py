"""One object on its way from mesh to cloud, with all that lies between: what the figure shows.

It is scanned here (`scan_object`), or read from a dataset that was generated with keep_views=true
(`kept_object`). Either way the bytes are those that `generate.py` makes of it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.generation.provenance import Keep
from qs3.generation.view_files import KeptView, load_views
from qs3.meshes.io import load_mesh
from qs3.meshes.mesh import Mesh
from qs3.meshes.source import MeshItem
from qs3.report.inspection.surface import distance_to_mesh, surfaces_of
from qs3.store.manifest import read_manifest
from qs3.store.parts import VIEWS
from qs3.store.store import has_variant, open_pointset, read_meta
from qs3.utils.plural import counted
from qs3.utils.seeding import object_rng

_OFTEN_THERE = "chair/train/chair_0000"


@dataclass(frozen=True, eq=False)
class ScannedObject:
    """An object, its views and its clouds.

    Attributes:
        name: its id.
        domain: what the domain is called, and what was changed in its settings.
        sensor: class of the sensor; "" where nothing was looked at.
        renderer: its name; "" likewise.
        views: by number; none where nothing was looked at.
        cloud: [P, 3] float32, metres: fused and sampled, as training gets it.
        clean: [P, 3] float32 its clean twin, or None.
        mesh: as it stood before the sensor; None if it is not known.
        why_no_mesh: says why.
        settings: of the recipe that made it, instantiated; None if it was read.
    """

    name: str
    domain: str
    sensor: str
    renderer: str
    views: tuple[KeptView, ...]
    cloud: np.ndarray
    clean: np.ndarray | None
    mesh: Mesh | None
    why_no_mesh: str = ""
    settings: Any = None

    def view(self, number: int) -> KeptView | None:
        """A view by its number; None where nothing was looked at.

        Raises:
            ConfigError: the object has no such view.
        """
        found = [view for view in self.views if view.number == number]
        if self.views and not found:
            there = ", ".join(str(view.number) for view in self.views)
            raise ConfigError(f"view={number}: {self.name} has the views {there}")
        return found[0] if found else None

    def fused(self) -> np.ndarray:
        """[M, 3] float64 what all views measured, before crop and sampling, in believed poses."""
        parts = [view.frame.points(view.frame.depth_m, view.believed) for view in self.views]
        return np.concatenate([*parts, np.zeros((0, 3))])

    @cached_property
    def residual_m(self) -> np.ndarray | None:
        """[P] distance of each point of `cloud` to the mesh, or None if that is not known.

        Positive behind the surface as the point's camera sees it, negative before it. Samples of
        a surface have no camera, and their distances no sign.
        """
        if self.mesh is None:
            return None
        eyes = self._eyes()
        if eyes is None:
            return distance_to_mesh(self.cloud, self.mesh, np.random.default_rng(0))
        return signed_distance_m(self.cloud, eyes, self.mesh)

    def _eyes(self) -> np.ndarray | None:
        """[P, 3] where the camera of each point of the cloud stood."""
        if not self.views:
            return None
        counts = [int(np.isfinite(view.frame.depth_m).sum()) for view in self.views]
        eyes = np.stack([view.believed[:3, 3] for view in self.views])
        _, nearest = cKDTree(self.fused()).query(self.cloud)  # the point itself, but for rounding
        return np.repeat(eyes, counts, axis=0)[nearest]


def signed_distance_m(points: np.ndarray, eyes_m: np.ndarray, mesh: Mesh) -> np.ndarray:
    """[P] distance of points [P, 3] to a mesh, positive behind it as seen from eyes [P, 3].

    Behind is where going on, away from the eye, leads away from the nearest surface.
    """
    points = np.asarray(points, dtype=np.float64)

    def distance(at: np.ndarray) -> np.ndarray:
        return distance_to_mesh(at, mesh, np.random.default_rng(0))

    away = points - eyes_m
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    found = distance(points)
    step = 0.1 * found[:, None] * away
    return np.where(distance(points + step) >= distance(points - step), found, -found)


def scan_object(
    overrides: Sequence[str], object_id: str | None = None, mesh: str | Path | None = None
) -> ScannedObject:
    """Run one object through a domain's recipe.

    Args:
        overrides: of generate.py, such as ["domain=specklenet10", "renderer=mitsuba"].
        object_id: which object; None: a chair, or the first there is.
        mesh: a mesh file to scan in place of the domain's objects.

    Raises:
        ConfigError: a setting is wrong, or there is no such object.
        MeshError, RenderError, DataError: it cannot be scanned.
    """
    from qs3.config.hydra import build
    from qs3.generation.scan import Scanner, composed_recipe

    cfg = composed_recipe(overrides)
    scanner = Scanner(cfg)
    recipe, domain = scanner.recipe, build(cfg.domain)
    item = _item_of_file(cfg, mesh, object_id) if mesh is not None else _item(cfg, object_id)
    looks = recipe.needs_renderer
    loaded = item.load()
    placed = recipe.placing.place(loaded, object_rng(cfg.seed, item.id, 0), item.id)
    with tempfile.TemporaryDirectory(prefix="qs3-pipeline-") as folder:
        keep = Keep(views=Path(folder)) if looks else Keep()
        made = scanner.cloud(loaded, item.id, keep)
        views = load_views(Path(folder), item.id)
    shown = ("domain=", "renderer=", "paths.", "workers=")
    changed = [word for word in overrides if not word.startswith(shown)]
    return ScannedObject(
        name=item.id,
        domain=domain.label + (f" with {' '.join(changed)}" if changed else ""),
        sensor=type(recipe.sensor).__name__ if looks else "",
        renderer=str(cfg.renderer.get("name", "")),
        views=views,
        cloud=made.arrays["points"],
        clean=made.arrays.get("points_clean"),
        mesh=placed,
        settings=recipe,
    )


def kept_object(
    folder: str | Path, object_id: str | None = None, meshes: str | Path | None = None
) -> ScannedObject:
    """Read one object (None: the first) of a dataset that was generated with keep_views=true.

    Nothing is scanned or instantiated from what the dataset's files say. `meshes`: the folder of
    meshes that it was made from, if it was.

    Raises:
        MissingDataError, DataError: it is not a dataset, or damaged.
        ConfigError: there is no such object, or its views were not kept.
    """
    folder = Path(folder)
    data, meta = open_pointset(folder), read_meta(folder)
    name = data.ids[0] if object_id is None else object_id
    if name not in data.ids:
        raise ConfigError(f"object={name} is not in {folder}{_near(name, data.ids)}")
    settings = meta.get("settings") or {}
    looked = "sensor" in (settings.get("recipe") or {})
    views = load_views(folder / VIEWS, name)
    if looked and not views:
        raise ConfigError(
            f"{folder} holds no views of {name}; generate it with keep_views=true, or scan the "
            f"object again: qs3 report pipeline domain=... object={name}"
        )
    at = data.ids.index(name)
    clean = None
    if has_variant(folder, "points_clean"):
        clean = np.array(open_pointset(folder, "points_clean").points[at])
    surfaces, why = surfaces_of(dict(meta), None if meshes is None else Path(meshes))
    rows = {row.id: row for row in read_manifest(folder, data.classes)}
    mesh = surfaces.mesh(rows[name]) if surfaces else None
    if surfaces and mesh is None:
        why = "the mesh found is not the one that was scanned"
    target = str((settings.get("recipe") or {}).get("sensor", {}).get("_target_", ""))
    return ScannedObject(
        name=name,
        domain=f"dataset {data.name}",
        sensor=target.rsplit(".", 1)[-1],
        renderer=str((settings.get("renderer") or {}).get("name", "")),
        views=views,
        cloud=np.array(data.points[at]),
        clean=clean,
        mesh=mesh,
        why_no_mesh=why,
    )


def _item(cfg: Any, object_id: str | None) -> MeshItem:
    from qs3.generation.objects import mesh_items

    items = {item.id: item for item in mesh_items(cfg)}
    if object_id is None:
        return items.get(_OFTEN_THERE) or next(iter(items.values()))
    if object_id not in items:
        raise ConfigError(f"object={object_id} is not in the domain{_near(object_id, items)}")
    return items[object_id]


def _item_of_file(cfg: Any, path: str | Path, object_id: str | None) -> MeshItem:
    path = Path(path).expanduser()
    if path.is_dir():
        raise ConfigError(
            f"mesh={path} is a folder: give one file, or meshes={path} and, with object=, the "
            "place of one in it (class/split/name)"
        )
    if not path.is_file():
        raise MissingDataError(f"mesh={path}: there is no such file")
    up = "y" if cfg.up == "y" else "z"
    load = partial(load_mesh, path, keep_colliders=cfg.colliders == "keep", up=up)
    return MeshItem(object_id or path.stem, "", "train", load, path.name, path)


def _near(name: str, known: Any) -> str:
    """The end of a message: what there is instead."""
    alike = [other for other in known if other.split("/")[0] == name.split("/")[0]]
    some = (alike or list(known))[:3]
    if not some:
        raise DataError("it holds no objects")
    return f"; {counted(len(known), 'object is', 'objects are')} there, such as {', '.join(some)}"
