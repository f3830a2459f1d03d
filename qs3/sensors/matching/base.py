"""What a matcher is asked for and gives back: exchangeable in every sensor that matches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from qs3.sensors.pixel_status import Reason


@dataclass(frozen=True, eq=False)
class Match:
    """Disparities of one image.

    Attributes:
        disparity: [h, w] float32 in px, NaN where there is no match.
        reason: [h, w] uint8, `Reason.OK` where there is one, else why not, as far as the
            matcher knows.
    """

    disparity: np.ndarray
    reason: np.ndarray

    @staticmethod
    def of(disparity: np.ndarray, why_not: np.ndarray | Reason = Reason.UNMATCHED) -> Match:
        """From disparities with NaN, and the reason that holds where they are NaN."""
        reason = np.where(np.isfinite(disparity), np.uint8(Reason.OK), np.uint8(why_not))
        return Match(disparity, reason.astype(np.uint8))


class Matcher(Protocol):
    """Finds each pixel of one rectified image in another.

    A pixel in column u of `image` is looked for in the same row of `other`, in the columns
    u + first - d, where d is min_disparity .. min_disparity + num_disparities - 1 px. That
    serves two cameras (image: the left, other: the right one; d = f b / Z) and a camera with
    a stored picture of its pattern (d = f b (1 / Z - 1 / Z_reference)).
    """

    @property
    def min_disparity(self) -> int:
        """Smallest disparity searched."""
        ...

    @property
    def num_disparities(self) -> int:
        """How many whole disparities are searched."""
        ...

    @property
    def reach_px(self) -> int:
        """How far from a pixel the images have an influence on it: half a block, or more."""
        ...

    def match(self, image: np.ndarray, other: np.ndarray, first: int = 0) -> Match:
        """Match every pixel of `image`.

        Args:
            image: [h, w] uint8.
            other: [h, W] uint8 or float32 (0..255), the same rows.
            first: column of `other` that column 0 of `image` has at zero disparity; what
                lies outside `other` matches nothing.

        Returns:
            [h, w] disparities.
        """
        ...


def side_by_side(
    image: np.ndarray, other: np.ndarray, first: int, low: int, high: int, margin: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """Both images on canvases of one size, for matchers that want that (OpenCV's).

    Args:
        image, other, first: as in `Matcher.match`.
        low, high: smallest and largest disparity searched.
        margin: px around, dark.

    Returns:
        Two [h, width] uint8 arrays, dark where there is nothing, and the column at which
        `image` starts in the first. In the second, the pixel that `image` column c meets at
        disparity d is in column start + c - d.
    """
    height, width = image.shape
    start = margin + max(high, 0)
    total = start + width + margin + max(-low, 0)
    a = np.zeros((height, total), dtype=np.uint8)
    a[:, start : start + width] = image
    b = np.zeros_like(a)
    # Column x of `other` goes to column x + shift.
    shift = start - first
    lo, hi = max(0, -shift), min(other.shape[1], total - shift)
    if hi > lo:
        part = other[:, lo:hi]
        if part.dtype != np.uint8:
            part = np.clip(np.rint(part), 0, 255).astype(np.uint8)
        b[:, lo + shift : hi + shift] = part
    return a, b, start
