"""Datasets as commands name them, the true surfaces of generated ones, and clouds to be shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from qs3.catalogue import Catalogue
from qs3.config.compose import choices
from qs3.datasets.domain import Domain, compose_domain
from qs3.errors import ConfigError
from qs3.geometry.sampling import surface_sample
from qs3.meshes.mesh import Mesh, MeshItem
from qs3.meshes.placement import OnFurniture, Placing, RealSize, UnitCube
from qs3.report.sheets import drawn
from qs3.report.viewer import Part, Shown
from qs3.store.meta import MadeOf, ManifestRow, is_finished, read_manifest
from qs3.store.store import PointSet, open_pointset, open_table
from qs3.utils.progress import progress_bar
from qs3.utils.seeding import object_rng

_SAMPLES = 8192  # of a surface
_PAIRS = 1 << 18  # of points and triangles at once

# A store may come from anybody: only these are made from what its meta.yaml says.
_PLACINGS = {f"{c.__module__}.{c.__qualname__}": c for c in (UnitCube, RealSize, OnFurniture)}
_CATALOGUE = "qs3.catalogue.Catalogue"

# As `qs3.generation.kept` writes them, which stands above this package.
_VIEW, _RESIDUAL, _NO_RESIDUAL_M = "view", "residual_m", -99.0


@dataclass(frozen=True, eq=False)
class Opened:
    """A dataset, its manifest's rows (also of failed objects), and what to call it.

    `name` is short, for file names; `label` has title and symbol. `made_of` is the domain's, which
    knows how many clouds were published. `unit` is "m", or "" where it is not known.
    """

    name: str
    label: str
    folder: Path
    variant: str
    data: PointSet
    rows: tuple[ManifestRow, ...]
    made_of: MadeOf
    unit: str = ""

    @property
    def kept(self) -> list[ManifestRow]:
        """The rows of the clouds, in order."""
        return [row for row in self.rows if row.status == "ok"]

    @property
    def twin(self) -> PointSet | None:
        """The clean twins of these clouds, if the store has them."""
        if self.variant == "points_clean" or "points_clean" not in self.data.meta["sha256"]:
            return None
        return open_pointset(self.folder, "points_clean", verify=False)


def open_named(name: str, overrides: Mapping[str, str]) -> Opened:
    """Open a domain by the name of its config, or a store by its folder.

    Overrides are keys of the domain's config (`variant`, `published.folder`) or `paths.data_dir`;
    of a folder only `variant`.

    Raises:
        ConfigError: there is no such domain, or no such key.
        MissingDataError: the domain's files are not there.
        DataError: they are damaged.
    """
    if not is_finished(name) and (name in choices("domain") or not Path(name).exists()):
        domain = compose_domain(name, overrides)
        domain.tell_of_judging()
        return opened_domain(domain, domain.open())
    if unknown := sorted({*overrides} - {"variant", "paths.data_dir"}):
        raise ConfigError(f"{', '.join(unknown)}: a dataset's folder takes variant= alone")
    folder, variant = Path(name).expanduser(), overrides.get("variant", "points")
    data = open_pointset(folder, variant)
    more = [variant] * (variant != "points") + ["simulated"] * bool(data.meta.get("simulated"))
    label = f"{data.name} ({', '.join(more)})" if more else data.name
    rows = tuple(read_manifest(folder, data.classes))
    return Opened(data.name, label, folder, variant, data, rows, data.made_of)


def opened_domain(domain: Domain, data: PointSet) -> Opened:
    """A domain whose dataset is open."""
    rows = tuple(read_manifest(domain.folder, data.classes))
    where = (domain.name, domain.label, domain.folder, domain.variant)
    return Opened(*where, data, rows, domain.made_of(data), "m" * (domain.unit == "metres"))


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The meshes (by id) of a generated dataset, placed as they were scanned."""

    seed: int
    placing: Placing
    items: dict[str, MeshItem] = field(default_factory=dict)

    def mesh(self, row: ManifestRow) -> Mesh | None:
        """The object's placed mesh; None if it is not the one that was scanned."""
        item = self.items.get(row.id.split("~")[0])
        if item is None or (mesh := item.load()).sha256 != row.mesh_sha256:
            return None
        return self.placing.place(mesh, object_rng(self.seed, row.id, 0), row.id)


def surfaces_of(meta: Mapping[str, Any]) -> Surfaces | None:
    """The surfaces of a store that was generated from the embedded catalogue, by its `meta`."""
    settings = meta.get("settings") or {}
    recipe, source = settings.get("recipe") or {}, settings.get("meshes")
    placing = dict(recipe.get("placing") or {"_target_": next(iter(_PLACINGS))})
    make = _PLACINGS.get(placing.pop("_target_", ""))
    values = dict(source) if isinstance(source, dict) else {}
    if make is None or recipe.get("poses") or values.pop("_target_", "") != _CATALOGUE:
        return None
    items = {item.id: item for item in Catalogue(**values).items()}
    return Surfaces(int(settings["seed"]), make(**placing), items)


def distance_to_mesh(points: Float[np.ndarray, "p 3"], mesh: Mesh) -> Float[np.ndarray, " p"]:
    """Distance of each point to the surface, in the mesh's unit; exact.

    Samples of the surface bound the distance from above; then every triangle is tried whose ball
    about its centre comes within the bound.
    """
    from trimesh.triangles import closest_point

    points = np.asarray(points, dtype=np.float64)
    samples = surface_sample(mesh.vertices, mesh.faces, _SAMPLES, np.random.default_rng(0))
    best = cKDTree(samples).query(points)[0] * (1 + 1e-6)
    corners = mesh.vertices[mesh.faces]
    centres = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    size = np.ceil(np.log2(np.maximum(radius, 1e-12)))  # so that one large one costs no more
    for power in np.unique(size):
        faces = np.flatnonzero(size == power)
        near = cKDTree(centres[faces]).query_ball_point(points, best + 2.0**power)
        point = np.repeat(np.arange(len(points)), [len(found) for found in near])
        face = faces[np.concatenate([*near, []]).astype(int)]
        for start in range(0, len(point), _PAIRS):
            at, of = point[start : start + _PAIRS], face[start : start + _PAIRS]
            off = closest_point(corners[of], points[at]) - points[at]
            np.minimum.at(best, at, np.linalg.norm(off, axis=1))
    return best


def chosen(data: PointSet, most: int, match: str = "") -> list[int]:
    """Positions of at most so many clouds whose ids hold `match`: as many of each class."""
    there = np.array([match in id_ for id_ in data.ids])
    groups = [data.labels == k for k in np.unique(data.labels)]
    members = [found for group in groups if len(found := np.flatnonzero(group & there))]
    taken: list[int] = []
    for i, own in enumerate(sorted(members, key=len)):  # what small classes leave, others get
        taken += drawn(own, -(-(most - len(taken)) // (len(members) - i)))
    return sorted(taken[:most], key=lambda i: (data.labels[i], i))


def part_of(opened: Opened, positions: Sequence[int], residuals: bool = True) -> Part:
    """Clouds of a dataset for the viewer, in this order.

    A residual is, of a dataset that was generated with `provenance=true`, how far the sensor's
    depth was off; else the distance to the mesh, where that can be made again; else to the nearest
    point of the clean twin, whose own spacing is then part of it.

    Args:
        opened: the dataset.
        positions: of its clouds.
        residuals: also where they must be computed (some tenths of a second a cloud).
    """
    data, kept = opened.data, opened.kept
    table, names = None, tuple[str, ...]()
    if opened.variant == "points" and "provenance" in data.meta.get("tables", {}):
        table, names = open_table(opened.folder)

    def column(name: str, i: int) -> np.ndarray | None:
        if table is None or name not in names:
            return None
        return np.asarray(table[i, :, names.index(name)], dtype=np.float64)

    surfaces, twin, words = None, None, "error of the depth that the sensor measured"
    if _RESIDUAL not in names and residuals:
        surfaces, twin = surfaces_of(data.meta), opened.twin
        words = "distance to the mesh" if surfaces else "distance to the clean twin's nearest point"
    shown = []
    with progress_bar("clouds", total=len(positions)) as advance:
        for i in positions:
            points = np.asarray(data.points[i], dtype=np.float64)
            view, residual = column(_VIEW, i), column(_RESIDUAL, i)
            if residual is not None:
                residual = np.where(residual == _NO_RESIDUAL_M, np.nan, np.abs(residual))
            elif surfaces is not None:
                mesh = surfaces.mesh(kept[i])
                residual = None if mesh is None else distance_to_mesh(points, mesh)
            elif twin is not None:
                residual = np.asarray(cKDTree(twin.points[i]).query(points)[0])
            label = "" if data.labels[i] < 0 else data.classes[data.labels[i]]
            note = ", ".join(filter(None, (kept[i].origin, kept[i].more.get("tier", ""))))
            views = None if view is None else view.astype(np.int64)
            one = Shown(data.ids[i], points, label, note=note, view=views, residual=residual)
            shown.append(one)
            advance()
    about = f"{len(shown)} of {len(data)} clouds of {opened.label}, made of: {opened.made_of}"
    known = any(one.residual is not None for one in shown)
    return Part(shown, about, opened.unit, words if known else "")
