"""Objects and cameras put exactly where the authors had them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from qs3.config.checks import check_ranges
from qs3.errors import ConfigError, DataError
from qs3.generation.released.poses import PoseTable, read_poses
from qs3.meshes.mesh import Mesh


@dataclass(frozen=True, eq=False)
class ReleasedPlacing:
    """Scale, yaw and location of the released poses.

    The released scale is 1 over the largest side of the authors' mesh, and its location brings
    the middle of its box to the origin. A mesh for which that does not hold is not theirs, or is
    in other units or has another axis up; it is refused with the reason, so that its views do
    not miss it.

    Attributes:
        table: of all shapes.
        max_error: how far the largest side may be from 1 m, and the middle from the origin (m).
    """

    table: PoseTable
    max_error: float = 0.01

    def __post_init__(self) -> None:
        check_ranges(self, "recipe.poses.", max_error="> 0")

    def place(self, mesh: Mesh, rng: np.random.Generator, object_id: str) -> Mesh:
        """A scaled, turned and moved copy; draws nothing.

        Raises:
            DataError: there is no pose for it, or the mesh is not the one that was posed.
        """
        pose = self.table.of(object_id)
        low, high = mesh.bounds
        side = float((high - low).max()) * pose.scale
        c, s = np.cos(pose.yaw_rad), np.sin(pose.yaw_rad)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        middle = turn @ ((low + high) / 2 * pose.scale) + pose.location_m
        if abs(side - 1) > self.max_error:
            raise DataError(
                f"this is not the mesh that was posed: its largest side is {side:.4g} m with the "
                f"released scale {pose.scale:.6g}, not 1 m (other units or another model?); "
                f"recipe.poses.max_error={self.max_error} is the limit"
            )
        if np.abs(middle).max() > self.max_error:
            raise DataError(
                "this is not the mesh that was posed: the middle of its box is at "
                f"({', '.join(f'{value:.3f}' for value in middle)}) m, not at the origin (another "
                f"origin or axis up?); recipe.poses.max_error={self.max_error} is the limit"
            )
        return mesh.at(mesh.vertices * pose.scale @ turn.T + pose.location_m)


@dataclass(frozen=True, eq=False)
class ReleasedViews:
    """The cameras of the released poses.

    Attributes:
        table: of all shapes.
        count: the first so many of each; at most `table.views`.
    """

    table: PoseTable
    count: int = 5

    def __post_init__(self) -> None:
        if not 1 <= self.count <= self.table.views:
            raise ConfigError(
                f"views={self.count}: the file of poses has 1 to {self.table.views} of each shape"
            )

    def poses(
        self, rng: np.random.Generator, box_m: np.ndarray, object_id: str
    ) -> list[np.ndarray]:
        """`count` poses [4, 4] world_from_camera; draws nothing, and the box says nothing.

        Raises:
            DataError: there is no pose for it.
        """
        return list(self.table.of(object_id).world_from_camera[: self.count])


@dataclass(frozen=True, eq=False)
class PoseFile:
    """Poses from a file: takes the place of a recipe's own placing and views.

    Attributes:
        path: see `read_poses`; read once, where the recipe is made, and sent on as a table.
        max_error: see `ReleasedPlacing`.
    """

    path: str
    max_error: float = 0.01
    table: PoseTable = field(init=False)

    def __post_init__(self) -> None:
        if not isinstance(self.path, str) or not self.path.strip():
            raise ConfigError(f"poses must name a file or folder, got {self.path!r}")
        object.__setattr__(self, "table", read_poses(Path(self.path).expanduser()))

    @property
    def placing(self) -> ReleasedPlacing:
        """Puts objects where they were."""
        return ReleasedPlacing(self.table, self.max_error)

    def views(self, count: int) -> ReleasedViews:
        """Puts `count` cameras where they were."""
        return ReleasedViews(self.table, count)


def pose_file(path: str | None, max_error: float = 0.01) -> PoseFile | None:
    """A `PoseFile`, or None without a path: poses= decides."""
    return None if path is None else PoseFile(path, max_error)
