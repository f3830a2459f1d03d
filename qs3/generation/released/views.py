"""The released code's law of poses, and its box around an object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qs3.config.checks import check_order, check_ranges
from qs3.errors import ConfigError
from qs3.generation.camera_poses import direction
from qs3.geometry.cameras import look_at, rotation_xyz
from qs3.meshes.mesh import Mesh

_FLIP = np.diag([1.0, -1.0, -1.0])  # Blender's cameras look along -z with y up


@dataclass(frozen=True)
class GrowingJitterViews:
    """The poses of the released code (and, with `count` 5, of the released pose files).

    View 0 looks at the origin. View i (counted from 0) moves each coordinate of its place by a
    normal draw of sigma `shift_sigma_m * (i + 1) / count`, and each of its Euler angles (Blender's
    XYZ: added to the angles, not composed with the rotation) by one of sigma
    `turn_sigma_rad * (i + 1) / count`, all clipped; it does not aim again.

    The 5,039 released files say the same. View 0 aims at the origin to 3e-5 degrees. Maximum
    likelihood of the clipped normal gives 0.0203, 0.0302, 0.0397, 0.0503 m and 0.0399, 0.0592,
    0.0800, 0.0989 rad for views 1 to 4, the same on every axis and without correlation; 4.8 % of
    the last view's shifts and 31 % of its turns are 0.1 exactly, which they could not be if the
    turns were composed. The azimuth covers -90 to 90 degrees evenly.

    Attributes:
        count: views an object.
        min_distance_m, max_distance_m, min_elevation_deg, max_elevation_deg: of view 0, uniform.
        min_azimuth_deg, max_azimuth_deg: of view 0, uniform; from the x axis towards y. Objects
            have a random yaw, so half a circle leaves no side of them out.
        shift_sigma_m, turn_sigma_rad: of the last view.
        max_shift_m, max_turn_rad: larger draws become this.
    """

    count: int = 5
    min_distance_m: float = 3.0
    max_distance_m: float = 5.0
    min_elevation_deg: float = 20.0
    max_elevation_deg: float = 50.0
    min_azimuth_deg: float = -90.0
    max_azimuth_deg: float = 90.0
    shift_sigma_m: float = 0.05
    turn_sigma_rad: float = 0.1
    max_shift_m: float = 0.1
    max_turn_rad: float = 0.1

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ConfigError(f"views must be at least 1, got {self.count}: set views=N")
        check_order(self, "recipe.views.", "distance_m", "elevation_deg", "azimuth_deg")
        drift = ("shift_sigma_m", "turn_sigma_rad", "max_shift_m", "max_turn_rad")
        check_ranges(self, "recipe.views.", min_distance_m="> 0", **dict.fromkeys(drift, ">= 0"))

    def poses(
        self, rng: np.random.Generator, box_m: np.ndarray, object_id: str = ""
    ) -> list[np.ndarray]:
        """`count` poses [4, 4] world_from_camera around a box [2, 3]; the first is the anchor."""
        target_m = box_m.mean(axis=0)
        distance = rng.uniform(self.min_distance_m, self.max_distance_m)
        elevation = np.deg2rad(rng.uniform(self.min_elevation_deg, self.max_elevation_deg))
        azimuth = np.deg2rad(rng.uniform(self.min_azimuth_deg, self.max_azimuth_deg))
        anchor = look_at(target_m + distance * direction(azimuth, elevation), target_m)
        angles = euler_xyz(anchor[:3, :3] @ _FLIP)
        poses = [anchor]
        for i in range(1, self.count):
            grown = (i + 1) / self.count
            shift = self.shift_sigma_m * grown * rng.standard_normal(3)
            turn = self.turn_sigma_rad * grown * rng.standard_normal(3)
            pose = anchor.copy()
            pose[:3, 3] += np.clip(shift, -self.max_shift_m, self.max_shift_m)
            turned = angles + np.clip(turn, -self.max_turn_rad, self.max_turn_rad)
            pose[:3, :3] = rotation_xyz(turned) @ _FLIP
            poses.append(pose)
        return poses


def euler_xyz(rotation: np.ndarray) -> np.ndarray:
    """[3] angles (rad) with rotation = Rz Ry Rx, of a [3, 3] rotation; Ry within a quarter turn."""
    flat = np.hypot(rotation[0, 0], rotation[1, 0])
    return np.array(
        [
            np.arctan2(rotation[2, 1], rotation[2, 2]),
            np.arctan2(-rotation[2, 0], flat),
            np.arctan2(rotation[1, 0], rotation[0, 0]),
        ]
    )


def box_of_corners(mesh: Mesh, placed: Mesh) -> np.ndarray:
    """The axis-aligned box of the placed corners of the mesh's own box, as the released code crops.

    It holds the object's axis-aligned box and is up to sqrt(2) times as wide.

    Args:
        mesh: as it was loaded.
        placed: the same, scaled, turned and moved; vertices in the same order.

    Returns:
        [2, 3] lowest and highest corner in the world.
    """
    low, high = mesh.bounds
    middle, size = (low + high) / 2, float((high - low).max()) or 1.0

    def homogeneous(points: np.ndarray) -> np.ndarray:
        return np.column_stack([(points - middle) / size, np.ones(len(points))])

    # The placing is affine: found from the vertices, it also takes the corners along.
    moves, *_ = np.linalg.lstsq(homogeneous(mesh.vertices), placed.vertices, rcond=None)
    corners = np.stack(np.meshgrid(*np.stack([low, high]).T, indexing="ij"), axis=-1).reshape(8, 3)
    there = homogeneous(corners) @ moves
    return np.stack([there.min(axis=0), there.max(axis=0)])
