"""Where the camera stands: the paper's pose law and a hand-held walk around the object."""

from typing import Protocol, runtime_checkable

import numpy as np

from qs3.geometry.cameras import look_at, rotation_xyz
from qs3.utils.settings import Count, NotNegative, Positive, settings


@runtime_checkable
class Views(Protocol):
    """Where the camera stands."""

    @property
    def count(self) -> int:
        """Number of views."""
        ...

    def poses(
        self, rng: np.random.Generator, box_m: np.ndarray, object_id: str
    ) -> list[np.ndarray]:
        """`count` poses [4, 4] world_from_camera around a box [2, 3]."""
        ...


@settings
class AnchoredViews:
    """The paper's law (section 3.1): one random pose, and variants close to it.

    The anchor looks at the origin from 3 to 5 m at an elevation of 20 to 50 degrees; the
    other views shift it by up to 10 cm along each axis and turn it by up to 0.1 rad about
    each of its axes, uniformly. They do not aim at the object again.

    Repaired with respect to the released code: the azimuth covers the whole circle (there
    half of it) and the spread does not grow with the view's index.
    """

    count: Count = 5
    min_distance_m: Positive = 3.0
    max_distance_m: Positive = 5.0
    min_elevation_deg: float = 20.0
    max_elevation_deg: float = 50.0
    max_shift_m: NotNegative = 0.1
    max_turn_rad: NotNegative = 0.1

    def poses(
        self, rng: np.random.Generator, box_m: np.ndarray, object_id: str = ""
    ) -> list[np.ndarray]:
        """`count` poses [4, 4] world_from_camera around a box [2, 3]; the first is the anchor."""
        anchor = self.anchor(rng, box_m)
        poses = [anchor]
        for _ in range(self.count - 1):
            pose = anchor.copy()
            pose[:3, 3] += rng.uniform(-self.max_shift_m, self.max_shift_m, 3)
            turn = rng.uniform(-self.max_turn_rad, self.max_turn_rad, 3)
            pose[:3, :3] = anchor[:3, :3] @ rotation_xyz(turn)
            poses.append(pose)
        return poses

    def anchor(self, rng: np.random.Generator, box_m: np.ndarray) -> np.ndarray:
        """[4, 4] a pose that looks at the middle of the box."""
        target_m = box_m.mean(axis=0)
        distance = rng.uniform(self.min_distance_m, self.max_distance_m)
        elevation = np.deg2rad(rng.uniform(self.min_elevation_deg, self.max_elevation_deg))
        away = direction(self.azimuth_rad(rng), elevation)
        return look_at(target_m + distance * away, target_m)

    def azimuth_rad(self, rng: np.random.Generator) -> float:
        """From the x axis towards y."""
        return rng.uniform(0, 2 * np.pi)


@settings
class HandheldViews:
    """Someone walks along an arc around the object and holds the camera towards it."""

    count: Count = 4
    min_distance_m: Positive = 0.9  # from the circle around the footprint: not in a bed
    max_distance_m: Positive = 2.2
    min_elevation_deg: float = 15.0
    max_elevation_deg: float = 45.0
    min_arc_deg: float = 30.0  # over which the frames are spread
    max_arc_deg: float = 150.0
    aim_m: NotNegative = 0.08  # standard deviation of the point aimed at

    def poses(
        self, rng: np.random.Generator, box_m: np.ndarray, object_id: str = ""
    ) -> list[np.ndarray]:
        """`count` true poses [4, 4] around a box [2, 3], in the order of the walk."""
        target_m = box_m.mean(axis=0)
        radius = float(np.hypot(*(box_m[1] - box_m[0])[:2])) / 2
        start = rng.uniform(0, 2 * np.pi)
        arc = np.deg2rad(rng.uniform(self.min_arc_deg, self.max_arc_deg))
        poses = []
        for i in range(self.count):
            azimuth = start + arc * (i / max(self.count - 1, 1))
            elevation = np.deg2rad(rng.uniform(self.min_elevation_deg, self.max_elevation_deg))
            distance = radius + rng.uniform(self.min_distance_m, self.max_distance_m)
            aim = target_m + rng.normal(0, self.aim_m, 3)
            poses.append(look_at(target_m + distance * direction(azimuth, elevation), aim))
        return poses


@settings
class Drift:
    """Error of the tracked camera: a random walk from frame to frame, frame 0 exact."""

    shift_m: NotNegative = 0.0  # standard deviation of each step along each axis
    turn_rad: NotNegative = 0.0  # and about each axis

    def believed(self, poses: list[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
        """The poses that fusion uses instead of the true ones."""
        out = []
        error = np.eye(4)
        for pose in poses:
            out.append(pose @ error)
            step = np.eye(4)
            step[:3, :3] = rotation_xyz(rng.normal(0, self.turn_rad, 3))
            step[:3, 3] = rng.normal(0, self.shift_m, 3)
            error = error @ step
        return out


def direction(azimuth_rad: float, elevation_rad: float) -> np.ndarray:
    """[3] unit vector; the azimuth is from the x axis towards y."""
    flat = np.cos(elevation_rad)
    return np.array([flat * np.cos(azimuth_rad), flat * np.sin(azimuth_rad), np.sin(elevation_rad)])
