"""Targets before a camera: tilted planes, and a square before a wall.

The camera stands in the origin and looks along the world's x (qs3.geometry.cameras.look_at), so
that boxes of the world are boxes of the camera, and only the pixels wanted are rendered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qs3.geometry.cameras import Intrinsics, Window, look_at
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import Body

POSE = look_at(np.zeros(3), np.array([1.0, 0.0, 0.0]))
ALBEDO = 0.8
"""Albedo of all targets: a light wall."""

_QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def to_world(points_m: np.ndarray) -> np.ndarray:
    """[N, 3] of the camera's frame to the world's."""
    return points_m @ POSE[:3, :3].T


@dataclass(frozen=True)
class TiltedPlane:
    """A plane through a point of a pixel's ray, turned away from that ray.

    Attributes:
        depth_m: along the optical axis, at the centre of the region.
        tilt_deg: angle of incidence there; its sign is the side to which the plane recedes.
        across: the plane recedes along the rows of the image (along the baseline); else along
            the columns.
        centre_px: (u, v) of the region's centre, relative to the principal point.
    """

    depth_m: float
    tilt_deg: float = 0.0
    across: bool = True
    centre_px: tuple[float, float] = (0.0, 0.0)

    def inverse(self, focal_px: float) -> np.ndarray:
        """[3] (a, b, c) of 1 / Z = a x + b y + c, with x, y the tangents of a ray."""
        ray = np.array([self.centre_px[0] / focal_px, self.centre_px[1] / focal_px, 1.0])
        unit = ray / np.linalg.norm(ray)
        along = np.array([1.0, 0, 0]) if self.across else np.array([0, 1.0, 0])
        along -= (along @ unit) * unit
        along /= np.linalg.norm(along)
        angle = np.deg2rad(self.tilt_deg)
        normal = np.cos(angle) * unit - np.sin(angle) * along
        return normal / (normal @ ray * self.depth_m)

    def depth_at(self, u: np.ndarray, v: np.ndarray, focal_px: float) -> np.ndarray:
        """Depth at pixels relative to the principal point; not positive beyond the horizon."""
        a, b, c = self.inverse(focal_px)
        return 1 / (a * u / focal_px + b * v / focal_px + c)

    def region(self, k: Intrinsics, half_px: int, step_px: int = 1) -> Window:
        """The pixels to measure on: fewer where the depth would change much across them."""
        steep = abs(np.tan(np.deg2rad(self.tilt_deg)))
        flat = half_px if steep == 0 else min(half_px, int(0.12 * k.focal_px / steep))
        flat = max(flat, 2 * step_px + 1)
        wide, high = (flat, half_px) if self.across else (half_px, flat)
        u = round(k.cx_px + self.centre_px[0])
        v = round(k.cy_px + self.centre_px[1])
        return Window(u - wide, v - high, 2 * wide + 1, 2 * high + 1)

    def scene(
        self, k: Intrinsics, region: Window, margin_px: int
    ) -> tuple[tuple[Body, ...], np.ndarray]:
        """The plane, three margins wider than `region`, and the [2, 3] box of one margin."""
        body = Body(Mesh(to_world(self._corners(k, region, 3 * margin_px)), _QUAD), ALBEDO)
        part = to_world(self._corners(k, region, margin_px))
        return (body,), np.stack([part.min(axis=0) - 1e-4, part.max(axis=0) + 1e-4])

    def _corners(self, k: Intrinsics, region: Window, margin_px: int) -> np.ndarray:
        """[4, 3] where the rays through the corners of a grown region meet the plane."""
        low_u, low_v = region.left - margin_px - k.cx_px, region.top - margin_px - k.cy_px
        high_u = low_u + region.width - 1 + 2 * margin_px
        high_v = low_v + region.height - 1 + 2 * margin_px
        # Not so far out that the plane comes near its horizon or the camera.
        a, b, _ = self.inverse(k.focal_px) * self.depth_m
        slope, centre = (a, self.centre_px[0]) if self.across else (b, self.centre_px[1])
        if slope:
            reach = 0.7 * k.focal_px / abs(slope)
            if self.across:
                low_u, high_u = max(low_u, centre - reach), min(high_u, centre + reach)
            else:
                low_v, high_v = max(low_v, centre - reach), min(high_v, centre + reach)
        u = np.array([low_u, high_u, high_u, low_u])
        v = np.array([low_v, low_v, high_v, high_v])
        z = self.depth_at(u, v, k.focal_px)
        return np.stack([u / k.focal_px * z, v / k.focal_px * z, z], axis=1)


@dataclass(frozen=True)
class SquareBeforeWall:
    """A square that faces the camera, before a wall that does.

    Attributes:
        near_m, far_m: depths of the square and of the wall.
        half_px: half the square's side in the image.
        shift_px: (u, v) of the square's centre relative to the principal point. A fraction of a
            pixel lets edges fall between pixels.
    """

    near_m: float
    far_m: float
    half_px: float
    shift_px: tuple[float, float] = (0.0, 0.0)

    def scene(self, focal_px: float, around_px: int) -> tuple[tuple[Body, ...], np.ndarray]:
        """Square and wall, and the [2, 3] box of what is within `around_px` of the square."""
        u, v = self.shift_px
        front = _facing(self.near_m, u, v, self.half_px, focal_px)
        back = _facing(self.far_m, u, v, self.half_px + 3 * around_px, focal_px)
        bodies = (
            Body(Mesh(to_world(front), _QUAD), ALBEDO),
            Body(Mesh(to_world(back), _QUAD), ALBEDO),
        )
        part = to_world(_facing(self.far_m, u, v, self.half_px + around_px, focal_px))
        return bodies, np.stack([part.min(axis=0) - 1e-4, part.max(axis=0) + 1e-4])


def _facing(depth_m: float, u: float, v: float, half_px: float, focal_px: float) -> np.ndarray:
    """[4, 3] corners of a square that faces the camera and covers 2 half_px pixels."""
    px = depth_m / focal_px
    x = np.array([u - half_px, u + half_px, u + half_px, u - half_px]) * px
    y = np.array([v - half_px, v - half_px, v + half_px, v + half_px]) * px
    return np.stack([x, y, np.full(4, depth_m)], axis=1)
