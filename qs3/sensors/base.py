"""What every depth sensor is asked for and gives back."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from qs3.errors import ConfigError
from qs3.geometry.cameras import Camera, Window, project
from qs3.sensors.renderers.base import Body, Renderer


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """One depth image of a part of a scene, on a regular grid of pixels.

    Sample (r, c) belongs to the pixel (u, v) = (left + c * step_px, top + r * step_px) of
    `camera`: samples are pixels that were really measured, so no shift enters.

    Attributes:
        camera: where it was taken from.
        left, top: pixel of the first sample.
        step_px: spacing of the samples in pixels of the camera.
        depth_m: [h, w] float32 as measured, NaN where nothing was.
        clean_m: [h, w] float32 true depth at the same pixels, inf where nothing is hit.
        label: [h, w] uint8, Body.label of what is seen, 0 where nothing is.
        cosine: [h, w] float32, cosine of the angle of incidence on what is seen, 0 where
            nothing is.
        reason: [h, w] uint8 `Reason`, why a sample has a depth or none. Shadow and occlusion
            are told apart from other causes only if the scan was asked to `explain`.
        images: intermediate pictures by name ("left", "right", "disparity", ...), for
            looking at; their size is that of the matched canvas, not of `depth_m`.
    """

    camera: Camera
    left: int
    top: int
    step_px: int
    depth_m: np.ndarray
    clean_m: np.ndarray
    label: np.ndarray
    cosine: np.ndarray
    reason: np.ndarray
    images: dict[str, np.ndarray] = field(default_factory=dict)

    def points(self, depth_m: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
        """Back-project `depth_m` (self.depth_m or self.clean_m, possibly masked).

        Args:
            depth_m: [h, w]; pixels that are not finite are left out.
            world_from_camera: [4, 4], the pose that is believed: a drifting one or the true.

        Returns:
            [M, 3] float64 points in the world, row-major.
        """
        rows, cols = np.nonzero(np.isfinite(depth_m))
        k = self.camera.intrinsics
        z = depth_m[rows, cols].astype(np.float64)
        x = (self.left + cols * self.step_px - k.cx_px) / k.focal_px * z
        y = (self.top + rows * self.step_px - k.cy_px) / k.focal_px * z
        local = np.stack([x, y, z], axis=1)
        return local @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]


class DepthSensor(Protocol):
    """A depth camera that looks at bodies through a renderer."""

    def scan(
        self,
        bodies: tuple[Body, ...],
        box_m: np.ndarray,
        world_from_camera: np.ndarray,
        renderer: Renderer,
        rng: np.random.Generator,
        explain: bool = False,
    ) -> DepthFrame | None:
        """Take one frame.

        Args:
            bodies: the scene.
            box_m: [2, 3] axis-aligned box of the world; only the pixels that it covers are
                rendered and matched.
            world_from_camera: [4, 4] true pose.
            renderer: makes the images.
            rng: all randomness of this frame.
            explain: render also who sees and who lights each surface, for `DepthFrame.reason`
                and the images "lit" and "seen". Costs renders and changes nothing else.

        Returns:
            The frame, or None if the box is outside the view.
        """
        ...


def check_depths(sensor: Any) -> None:
    """Check the nearest and the farthest depth that a sensor gives.

    Raises:
        ConfigError: not 0 < min_depth_m < max_depth_m.
    """
    if not 0 < sensor.min_depth_m < sensor.max_depth_m:
        raise ConfigError(
            "sensor.min_depth_m and max_depth_m must satisfy 0 < min < max, got "
            f"{sensor.min_depth_m} and {sensor.max_depth_m}"
        )


def window_of(box_m: np.ndarray, camera: Camera, *, margin_px: int = 0) -> Window | None:
    """The pixels that an axis-aligned box covers, clipped to the image.

    Args:
        box_m: [2, 3] lowest and highest corner in the world.

    Returns:
        None if no part of the box is in front of the camera and inside the image.
    """
    corners = np.stack(np.meshgrid(*box_m.T, indexing="ij"), axis=-1).reshape(8, 3)
    pixels, depth = project(corners, camera)
    k = camera.intrinsics
    if (depth <= 0).all():
        return None
    if (depth <= 0).any():  # the box reaches behind the camera: its outline is unbounded
        low, high = np.zeros(2), np.array([k.width_px - 1, k.height_px - 1])
    else:
        low, high = np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0))
    left, top = (int(max(0, value - margin_px)) for value in low)
    right = int(min(k.width_px - 1, high[0] + margin_px))
    bottom = int(min(k.height_px - 1, high[1] + margin_px))
    if right < left or bottom < top:
        return None
    return Window(left, top, right - left + 1, bottom - top + 1)


def on_grid(start: int, count: int, step: int) -> tuple[int, slice]:
    """Every step-th of `count` pixels from `start`, on a grid that does not depend on them.

    Returns:
        The first pixel x >= start with x % step == step // 2, and the slice of the pixels.
    """
    first = start + (step // 2 - start) % step
    return first, slice(first - start, count, step)
