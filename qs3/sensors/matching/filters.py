"""What devices do to a disparity map after matching: quantise it, and drop what looks wrong."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar, Protocol

import cv2
import numpy as np

from qs3.config.checks import check_ranges


@dataclass(frozen=True)
class Quantiser:
    """The device's step of disparity.

    Attributes:
        steps_per_px: 8 is 1/8 px (Kinect v1), 32 is 1/32 px (RealSense D400); 0 is none.
    """

    steps_per_px: int = 0

    def __post_init__(self) -> None:
        check_ranges(self, steps_per_px=">= 0")

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """[h, w] float32, rounded to the nearest step; NaN stays."""
        if not self.steps_per_px:
            return disparity
        return (np.rint(disparity * self.steps_per_px) / self.steps_per_px).astype(np.float32)


class PostFilter(Protocol):
    """Changes or drops disparities.

    One whose class has `keeps_steps = True` gives no value that was not there before, so that the
    matcher's own steps stay.
    """

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """[h, w] float32 px with NaN -> the same, changed; dropped values are NaN."""


@dataclass(frozen=True)
class SmallRegions:
    """Drop islands: connected regions of similar disparity with few pixels.

    Attributes:
        max_size_px: regions with at most so many pixels go.
        max_step_px: neighbours (of 4) belong together if they differ by at most this.
    """

    keeps_steps: ClassVar[bool] = True
    max_size_px: int = 50
    max_step_px: float = 1.0

    def __post_init__(self) -> None:
        check_ranges(self, "SmallRegions.", max_size_px=">= 0", max_step_px="> 0")

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


@dataclass(frozen=True)
class Median:
    """Replace each value by the median of the valid ones in a window; holes stay holes.

    Attributes:
        size_px: side of the window, odd.
    """

    size_px: int = 3

    def __post_init__(self) -> None:
        check_ranges(self, "Median.", size_px="odd >= 3")

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """See `PostFilter.apply`."""
        stack = np.sort(_shifts(disparity, self.size_px), axis=0)  # NaN come last
        count = np.isfinite(stack).sum(axis=0)
        last = np.maximum(count - 1, 0)
        low, high = (
            np.take_along_axis(stack, place[None], axis=0)[0]
            for place in (last // 2, -(-last // 2))
        )
        return np.where(np.isfinite(disparity), (low + high) / 2, np.nan).astype(np.float32)


@dataclass(frozen=True)
class NeighbourCheck:
    """Drop values that too few neighbours agree with.

    Attributes:
        size_px: side of the window, odd.
        max_step_px: a neighbour agrees if it differs by at most this.
        min_share: share of the window's other pixels that must agree; missing ones do not.
    """

    keeps_steps: ClassVar[bool] = True
    size_px: int = 5
    max_step_px: float = 1.0
    min_share: float = 0.4

    def __post_init__(self) -> None:
        check_ranges(self, "NeighbourCheck.", size_px="odd >= 3", min_share="[0, 1]")

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """See `PostFilter.apply`."""
        near = np.abs(_shifts(disparity, self.size_px) - disparity) <= self.max_step_px
        others = self.size_px**2 - 1
        enough = near.sum(axis=0) - 1 >= self.min_share * others
        return np.where(enough, disparity, np.float32(np.nan)).astype(np.float32)


@dataclass(frozen=True)
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

    alpha: float = 0.5
    max_step_px: float = 1.0
    iterations: int = 2

    def __post_init__(self) -> None:
        check_ranges(self, "SpatialFilter.", alpha="(0, 1]", max_step_px="> 0", iterations=">= 1")

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """See `PostFilter.apply`."""
        out = np.array(disparity, dtype=np.float32)
        for _ in range(self.iterations):
            for axis in (1, 0):
                lines = np.ascontiguousarray(np.moveaxis(out, axis, 0))
                for ordered in (lines, lines[::-1]):
                    self._along(ordered)
                out = np.moveaxis(lines, 0, axis)
        return np.ascontiguousarray(out)

    def _along(self, lines: np.ndarray) -> None:
        """[n, m]: row i from row i - 1, in place."""
        alpha = np.float32(self.alpha)
        for before, here in itertools.pairwise(lines):
            with np.errstate(invalid="ignore"):
                near = np.abs(here - before) <= self.max_step_px  # false for NaN
            np.copyto(here, alpha * here + (1 - alpha) * before, where=near)


@dataclass(frozen=True)
class FillHoles:
    """Fill small holes by the farther side's disparity, as many drivers do.

    Attributes:
        max_width_px: gaps of a row that are wider stay.
    """

    keeps_steps: ClassVar[bool] = True
    max_width_px: int = 5

    def __post_init__(self) -> None:
        check_ranges(self, "FillHoles.", max_width_px=">= 1")

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """See `PostFilter.apply`."""
        height, width = disparity.shape
        valid = np.isfinite(disparity)
        columns = np.arange(width)
        before = np.maximum.accumulate(np.where(valid, columns, -1), axis=1)
        after = np.minimum.accumulate(np.where(valid, columns, width)[:, ::-1], axis=1)[:, ::-1]
        fill = ~valid & (before >= 0) & (after < width) & (after - before - 1 <= self.max_width_px)
        rows = np.arange(height)[:, None]
        left = disparity[rows, np.maximum(before, 0)]
        right = disparity[rows, np.minimum(after, width - 1)]
        return np.where(fill, np.fmin(left, right), disparity).astype(np.float32)


def _shifts(image: np.ndarray, size_px: int) -> np.ndarray:
    """[size * size, h, w]: the image shifted to every place of the window, NaN from outside."""
    half = size_px // 2
    height, width = image.shape
    padded = np.pad(image, half, constant_values=np.nan)
    return np.stack(
        [
            padded[dy : dy + height, dx : dx + width]
            for dy in range(size_px)
            for dx in range(size_px)
        ]
    )
