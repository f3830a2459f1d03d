"""What devices do to a disparity map after matching: quantise it, and drop what looks wrong."""

from typing import Annotated, Protocol, runtime_checkable

import cv2
import numpy as np
from annotated_types import Ge, Interval

from qs3.utils.settings import Count, Positive, settings


@settings
class Quantiser:
    """The device's step of disparity.

    Attributes:
        steps_per_px: 8 is 1/8 px (Kinect v1), 32 is 1/32 px (RealSense D400); 0 is none.
    """

    steps_per_px: Annotated[int, Ge(0)] = 0

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """[h, w] float32, rounded to the nearest step; NaN stays."""
        if not self.steps_per_px:
            return disparity
        return (np.rint(disparity * self.steps_per_px) / self.steps_per_px).astype(np.float32)


@runtime_checkable
class PostFilter(Protocol):
    """Changes or drops disparities."""

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """[h, w] float32 px with NaN -> the same, changed; dropped values are NaN."""


@settings
class SmallRegions:
    """Drop islands: connected regions of similar disparity with few pixels.

    Attributes:
        max_size_px: regions with at most so many pixels go.
        max_step_px: neighbours (of 4) belong together if they differ by at most this.
    """

    max_size_px: Annotated[int, Ge(0)] = 50
    max_step_px: Positive = 1.0

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """See `PostFilter.apply`."""
        valid = np.isfinite(disparity)
        if not valid.any():
            return disparity
        # OpenCV works on 16 bit integers; 1/32 px is finer than any threshold here.
        scale = min(32.0, 30_000 / max(float(np.abs(disparity[valid]).max()), 1.0))
        fixed = np.full(disparity.shape, -32_768, dtype=np.int16)
        fixed[valid] = np.rint(disparity[valid] * scale)
        cv2.filterSpeckles(fixed, -32_768, self.max_size_px, self.max_step_px * scale)
        return np.where(fixed == -32_768, np.float32(np.nan), disparity).astype(np.float32)


@settings
class SpatialFilter:
    """Smooth along rows and columns, stopping at steps, as the RealSense SDK's spatial filter.

    A recursive domain transform (Gastal and Oliveira, SIGGRAPH 2011; librealsense,
    rs2::spatial_filter): each value becomes alpha times itself and 1 - alpha times the value
    before it, forwards and backwards along rows, then along columns. Where two neighbours differ by
    more than `max_step_px`, or one is missing, it starts anew. Steps that are lower are smeared: a
    flying pixel is a value between the two surfaces.

    Attributes:
        alpha: 1 leaves everything as it is.
        max_step_px: of the disparity between neighbours.
        iterations: how often all four directions are gone.
    """

    alpha: Annotated[float, Interval(gt=0, le=1)] = 0.5
    max_step_px: Positive = 1.0
    iterations: Count = 2

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """See `PostFilter.apply`."""
        from qs3.sensors.matching.numba_kernels import smooth_lines

        out = np.array(disparity, dtype=np.float32)
        for axis in (1, 0) * self.iterations:
            lines = np.array(np.moveaxis(out, axis, 0).T, order="C")
            smooth_lines(lines, np.float32(self.alpha), np.float32(self.max_step_px))
            out = np.moveaxis(lines.T, 0, axis)
        return np.ascontiguousarray(out)
