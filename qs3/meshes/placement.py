"""How an object is put into the world before it is scanned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.mesh import Mesh


class Placing(Protocol):
    """Puts a mesh into the world."""

    def place(self, mesh: Mesh, rng: np.random.Generator, object_id: str) -> Mesh:
        """A scaled, moved and turned copy; `object_id` for those who look it up in a list."""
        ...


@dataclass(frozen=True)
class UnitCube:
    """The paper's placing: largest side 1 m, box centred on the origin, random yaw.

    Attributes:
        yaw: false leaves the object turned as its file has it, as ModelNet10's clouds are.
    """

    yaw: bool = True

    def place(self, mesh: Mesh, rng: np.random.Generator, object_id: str = "") -> Mesh:
        """A scaled, centred and turned copy."""
        yaw_rad = _yaw_rad(rng)  # drawn in any case: what else is drawn does not depend on it
        return _place(mesh, 1 / _largest_side(mesh), False, yaw_rad if self.yaw else 0.0)


@dataclass(frozen=True)
class RealSize:
    """The object keeps its size and stands on z = 0 with a random yaw.

    Meshes whose largest side is not between `min_side_m` and `max_side_m` are not in
    metres (ModelNet's are not); they are scaled to `fallback_side_m`.
    """

    min_side_m: float = 0.15
    max_side_m: float = 4.0
    fallback_side_m: float = 1.0

    def place(self, mesh: Mesh, rng: np.random.Generator, object_id: str = "") -> Mesh:
        """A turned copy on the floor."""
        side = _largest_side(mesh)
        plausible = self.min_side_m <= side <= self.max_side_m
        return _place(mesh, 1.0 if plausible else self.fallback_side_m / side, True, _yaw_rad(rng))


def _yaw_rad(rng: np.random.Generator) -> float:
    return rng.uniform(0, 2 * np.pi)


def _largest_side(mesh: Mesh) -> float:
    low, high = mesh.bounds
    side = float((high - low).max())
    if side <= 0:
        raise MeshError("the mesh has no extent: all its vertices are one point")
    return side


def _place(mesh: Mesh, scale: float, on_floor: bool, yaw_rad: float) -> Mesh:
    low, high = mesh.bounds
    anchor = (low + high) / 2
    if on_floor:
        anchor[2] = low[2]
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return Mesh((mesh.vertices - anchor) * scale @ turn.T, mesh.faces)
