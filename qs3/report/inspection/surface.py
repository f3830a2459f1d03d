"""The true surfaces of a generated dataset, and how far clouds lie from them.

A generated store knows its catalogue, its seed and its placing, so the mesh of each object can be
made again and put where it was scanned; its hash says whether it is the same one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from qs3.catalogue import Catalogue
from qs3.errors import Qs3Error
from qs3.geometry.sampling import surface_sample
from qs3.meshes.folder import MeshFolder
from qs3.meshes.mesh import Mesh
from qs3.meshes.placement import OnFurniture, Placing, RealSize, UnitCube
from qs3.meshes.source import MeshItem
from qs3.store.manifest import ManifestRow
from qs3.utils.seeding import object_rng

_SAMPLES = 8192  # of a surface
_PAIRS = 1 << 18  # of points and triangles at once

# A store may come from anybody: only these are made from what its meta.yaml says.
_PLACINGS = {f"{c.__module__}.{c.__qualname__}": c for c in (UnitCube, RealSize, OnFurniture)}
_DEFAULT_PLACING = next(iter(_PLACINGS))  # of the recipes: UnitCube
_CATALOGUE = "qs3.catalogue.Catalogue"


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The meshes (by id) of a generated dataset, placed as they were scanned."""

    seed: int
    placing: Placing
    items: dict[str, MeshItem] = field(default_factory=dict)

    def mesh(self, row: ManifestRow) -> Mesh | None:
        """The object's placed mesh; None if it is not the one that was scanned."""
        item = self.items.get(row.id.split("~")[0])
        if item is None:
            return None
        try:
            mesh = item.load()
        except Qs3Error:
            return None
        if mesh.sha256 != row.mesh_sha256:
            return None
        return self.placing.place(mesh, object_rng(self.seed, row.id, 0), row.id)


def surfaces_of(meta: dict[str, Any], meshes: Path | None = None) -> tuple[Surfaces | None, str]:
    """The surfaces of a store by its `meta`, or None and why they are not known.

    `meshes` is the folder that it was made from, if it was not the embedded catalogue.
    """
    settings = meta.get("settings")
    if not isinstance(settings, dict):
        return None, "the dataset was not generated here, so its meshes are not known"
    recipe = settings.get("recipe") or {}
    placing = dict(recipe.get("placing") or {"_target_": _DEFAULT_PLACING})
    make = _PLACINGS.get(placing.pop("_target_", ""))
    if recipe.get("poses"):
        return None, "the objects were placed by a file of poses"
    if make is None:
        return None, "the objects were placed in a way that is not known here"
    source = settings.get("meshes")
    if source == "folder":
        if meshes is None:
            return None, "it was made from a folder of meshes: give it with meshes=PATH"
        config = meta.get("config") or {}
        keys: dict[str, Any] = {
            key: config[key] for key in ("test_fraction", "half") if key in config
        }
        keys["keep_colliders"] = settings["colliders"] == "keep"
        keys["up"] = settings["up"]
        keys["classes"] = config.get("classes") or None
        keys["known"] = tuple(meta["classes"])
        items = MeshFolder(path=meshes, **keys).items()
    elif isinstance(source, dict) and source.get("_target_") == _CATALOGUE:
        values = {key: value for key, value in source.items() if key != "_target_"}
        items = Catalogue(**values).items()
    else:
        return None, "it was made from another catalogue"
    return Surfaces(int(settings["seed"]), make(**placing), {item.id: item for item in items}), ""


def distance_to_mesh(
    points: Float[np.ndarray, "p 3"], mesh: Mesh, rng: np.random.Generator
) -> Float[np.ndarray, " p"]:
    """Distance of each point to the surface, in the mesh's unit; exact.

    Samples of the surface bound the distance from above; then every triangle is tried whose ball
    about its centre comes within the bound. `rng` decides how fast that is, not the result.
    """
    points = np.asarray(points, dtype=np.float64)
    samples = surface_sample(mesh.vertices, mesh.faces, _SAMPLES, rng)
    best = cKDTree(samples).query(points)[0] * (1 + 1e-6)
    corners = mesh.vertices[mesh.faces]
    centres = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    size = np.ceil(np.log2(np.maximum(radius, 1e-12)))  # so that one large one costs no more
    for power in np.unique(size):
        faces = np.flatnonzero(size == power)
        tree = cKDTree(centres[faces])
        near = tree.query_ball_point(points, best + 2.0**power)
        many = np.array([len(found) for found in near])
        point = np.repeat(np.arange(len(points)), many)
        face = faces[np.concatenate([*near, []]).astype(int)]
        for start in range(0, len(point), _PAIRS):
            some = slice(start, start + _PAIRS)
            distance = _to_triangle(points[point[some]], corners[face[some]])
            np.minimum.at(best, point[some], distance)
    return best


def _to_triangle(
    points: Float[np.ndarray, "p 3"], corners: Float[np.ndarray, "p 3 3"]
) -> Float[np.ndarray, " p"]:
    """Distance of point i to triangle i."""
    from trimesh.triangles import closest_point

    return np.linalg.norm(closest_point(corners, points) - points, axis=1)
