"""Kinds of depth error that are taken out of a frame again, to learn what they are worth.

They come out of how a sensor forms its images, and are undone by the true depth. So scans with and
without them have the same views and noise, and no error is ever drawn from a mask.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from qs3.config.checks import check_bool, check_ranges
from qs3.sensors.base import DepthFrame


@dataclass(frozen=True)
class DepthErrors:
    """Which errors stay in a frame.

    Attributes:
        holes: False: where the object is seen and nothing was measured there is its true depth.
        mixed_pixels: False: a depth that no surface close by has, as at the edge between two, is
            dropped. It leaves a hole, which `holes` does not fill.
        reach_px: pixels of the camera to each side that count as close by: half a matcher's block
            and more, as blocks make surfaces wider; 6 for a Kinect's 9, 12 for the paper's 19.
        apart_m, apart_per_m: a depth z belongs to a surface that is nearer to it than apart_m +
            apart_per_m z^2. By default 2 cm and a fifth of a Kinect's pixel of disparity, three
            standard deviations of its noise.
    """

    holes: bool = True
    mixed_pixels: bool = True
    reach_px: int = 6
    apart_m: float = 0.02
    apart_per_m: float = 0.005

    def __post_init__(self) -> None:
        check_bool("depth_errors.holes", self.holes)
        check_bool("depth_errors.mixed_pixels", self.mixed_pixels)
        positive = dict.fromkeys(("apart_m", "apart_per_m"), ">= 0")
        check_ranges(self, "depth_errors.", reach_px=">= 1", **positive)

    def left_in(self, frame: DepthFrame) -> DepthFrame:
        """The frame with the errors that stay; its reasons and pictures are what they were."""
        depth, missing = frame.depth_m, np.isnan(frame.depth_m)
        if not self.mixed_pixels:
            depth = np.where(self.mixed(frame), np.float32(np.nan), depth)
        if not self.holes:
            depth = np.where(missing & (frame.label == 1), frame.clean_m, depth)
        return frame if depth is frame.depth_m else replace(frame, depth_m=depth)

    def mixed(self, frame: DepthFrame) -> Bool[np.ndarray, "h w"]:
        """Measured samples whose depth no true surface within `reach_px` has."""
        steps = max(1, self.reach_px // frame.step_px)
        close = _surface_near(frame.clean_m, frame.depth_m, steps)
        with np.errstate(invalid="ignore"):
            return close > self.apart_m + self.apart_per_m * frame.depth_m**2


def _surface_near(
    true_m: Float[np.ndarray, "h w"], depth_m: Float[np.ndarray, "h w"], steps: int
) -> Float[np.ndarray, "h w"]:
    """How far each depth is from the nearest of the true ones around it, m; NaN without a depth."""
    height, width = depth_m.shape
    near = np.where(np.isnan(depth_m), np.float32(np.nan), np.float32(np.inf))
    around = np.pad(true_m, steps, constant_values=np.inf)
    for row in range(2 * steps + 1):
        for column in range(2 * steps + 1):
            other = around[row : row + height, column : column + width]
            near = np.fmin(near, np.abs(depth_m - other))
    return near
