"""How an object is put into the world before it is scanned."""

from typing import Protocol, runtime_checkable

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.mesh import Mesh
from qs3.utils.settings import Positive, settings


@runtime_checkable
class Placing(Protocol):
    """Puts a mesh into the world."""

    def place(self, mesh: Mesh, rng: np.random.Generator, object_id: str) -> Mesh:
        """A scaled, moved and turned copy; `object_id` for those who look it up in a list."""


@settings
class UnitCube:
    """The paper's placing: largest side 1 m, box centred on the origin, random yaw.

    Attributes:
        yaw: false leaves the object turned as its file has it, as ModelNet10's clouds are.
    """

    yaw: bool = True

    def place(self, mesh: Mesh, rng: np.random.Generator, object_id: str = "") -> Mesh:
        """A scaled, centred and turned copy."""
        yaw_rad = rng.uniform(0, 2 * np.pi)  # in any case: other draws do not depend on `yaw`
        return _place(mesh, 1 / largest_side(mesh), False, yaw_rad if self.yaw else 0.0)


@settings
class RealSize:
    """The object keeps its size and stands on z = 0 with a random yaw.

    Meshes whose largest side is not between `min_side_m` and `max_side_m` are not in
    metres (ModelNet's are not); they are scaled to `fallback_side_m`.
    """

    min_side_m: Positive = 0.15
    max_side_m: Positive = 4.0
    fallback_side_m: Positive = 1.0

    def keeps(self, mesh: Mesh) -> bool:
        """Whether a mesh is in metres, by its largest side."""
        return self.min_side_m <= largest_side(mesh) <= self.max_side_m

    def place(self, mesh: Mesh, rng: np.random.Generator, object_id: str = "") -> Mesh:
        """A turned copy on the floor."""
        return self.stand(mesh, rng.uniform(0, 2 * np.pi))

    def stand(self, mesh: Mesh, yaw_rad: float = 0.0) -> Mesh:
        """A copy on the floor, its box's middle at x = y = 0."""
        scale = 1.0 if self.keeps(mesh) else self.fallback_side_m / largest_side(mesh)
        return _place(mesh, scale, True, yaw_rad)


def largest_side(mesh: Mesh) -> float:
    """Largest side of the mesh's box, in the mesh's own unit."""
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
    return mesh.at((mesh.vertices - anchor) * scale @ turn.T)
