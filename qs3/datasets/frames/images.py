"""A depth image, its camera, and the points of its pixels with z up.

Camera coordinates are those of `qs3.geometry.cameras`: x to the right, y down, z along the optical
axis; the centre of the top left pixel is at (0, 0). MATLAB counts pixels from 1, so a principal
point from there is one pixel less here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from qs3.errors import DataError

MAX_SIDE_PX = 4096
MOST_DEPTH_M = 100.0

CAMERA_UP = np.array([0.0, -1.0, 0.0])
"""Up in the picture, in camera coordinates."""


@dataclass(frozen=True)
class Pinhole:
    """A pinhole without distortion whose pixels need not be square.

    Attributes:
        fx_px, fy_px: focal lengths.
        cx_px, cy_px: principal point; the centre of the top left pixel is (0, 0).
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def __post_init__(self) -> None:
        values = (self.fx_px, self.fy_px, self.cx_px, self.cy_px)
        if not np.isfinite(values).all() or min(self.fx_px, self.fy_px) <= 0:
            raise DataError(f"focal lengths and principal point {values} are those of no camera")

    def rays(self, height_px: int, width_px: int) -> Float[np.ndarray, "h w 3"]:
        """(x, y, 1) of each pixel: times its depth, it is the pixel's point in the camera."""
        u, v = np.meshgrid(np.arange(width_px), np.arange(height_px))
        x, y = (u - self.cx_px) / self.fx_px, (v - self.cy_px) / self.fy_px
        return np.stack([x, y, np.ones_like(x)], axis=-1)


@dataclass(frozen=True, eq=False)
class DepthImage:
    """One depth image.

    Attributes:
        depth_m: [h, w] along the optical axis; 0 where nothing was measured.
        camera: that took it.
        world_from_camera: [3, 3] rotation to a frame with z up; the camera is its origin.
        area: rows from, rows to, columns from, columns to, where the sensor can have measured at
            all; None: everywhere.
    """

    depth_m: Float[np.ndarray, "h w"]
    camera: Pinhole
    world_from_camera: Float[np.ndarray, "3 3"]
    area: tuple[int, int, int, int] | None = None

    def __post_init__(self) -> None:
        depth = np.asarray(self.depth_m)
        if depth.ndim != 2 or not 1 <= max(depth.shape) <= MAX_SIDE_PX or depth.dtype.kind != "f":
            raise DataError(f"a depth image is floats [h, w], not {depth.dtype} {depth.shape}")
        measured = np.isfinite(depth) & (depth > 0) & (depth < MOST_DEPTH_M)
        object.__setattr__(self, "depth_m", np.where(measured, depth, 0).astype(np.float64))
        turn = np.asarray(self.world_from_camera, dtype=np.float64)
        near = turn.shape == (3, 3) and np.allclose(turn @ turn.T, np.eye(3), atol=1e-3)
        if not near or np.linalg.det(turn) < 0:
            raise DataError(f"no rotation to a frame with z up: {turn.tolist()}")

    @cached_property
    def points_m(self) -> Float[np.ndarray, "h w 3"]:
        """Points of all pixels, z up; the camera and pixels without depth are at the origin."""
        rays = self.camera.rays(*self.depth_m.shape)
        return (rays * self.depth_m[..., None]) @ np.asarray(self.world_from_camera).T

    @cached_property
    def inside(self) -> Bool[np.ndarray, "h w"]:
        """Pixels of `area`."""
        inside = np.zeros(self.depth_m.shape, dtype=bool)
        top, bottom, left, right = self.area or (0, inside.shape[0], 0, inside.shape[1])
        inside[top:bottom, left:right] = True
        return inside


def upright(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation to z up whose y axis is where the camera looks, level; x is to the right.

    Of a camera that looks straight down or up, y is up in the picture or down in it.

    Args:
        up: in camera coordinates, any length.

    Raises:
        DataError: no direction.
    """
    length = float(np.linalg.norm(up))
    if not np.isfinite(length) or length < 1e-9:
        raise DataError(f"{np.asarray(up).tolist()} points nowhere, so nobody knows what is up")
    z = np.asarray(up, dtype=np.float64) / length
    forward = np.array([0.0, 0.0, 1.0]) - z[2] * z
    if np.linalg.norm(forward) < 1e-6:  # z is along the optical axis, so this is level
        forward = -np.sign(z[2]) * CAMERA_UP
    y = forward / np.linalg.norm(forward)
    return np.stack([np.cross(y, z), y, z])
