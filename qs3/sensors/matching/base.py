"""What a matcher is asked for and gives back: exchangeable in every sensor that matches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from qs3.errors import ConfigError
from qs3.sensors.pixel_status import Reason


@dataclass(frozen=True, eq=False)
class Match:
    """Disparities of one image.

    Attributes:
        disparity: [h, w] float32 in px, NaN where there is no match.
        reason: [h, w] uint8, `Reason.OK` where there is one, else why not, as far as is known.
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

    @property
    def num_disparities(self) -> int:
        """How many whole disparities are searched."""

    @property
    def reach_px(self) -> int:
        """How far from a pixel the images have an influence on it: half a block, or more."""

    def match(self, image: np.ndarray, other: np.ndarray, first: int = 0) -> Match:
        """Match every pixel of `image`.

        Args:
            image: [h, w] uint8.
            other: [h, W] uint8 or float32 (0..255), the same rows.
            first: column of `other` that column 0 of `image` has at zero disparity; what lies
                outside `other` matches nothing.
        """


def found_px(matcher: Matcher) -> tuple[float, float]:
    """Smallest and largest disparity in px that a matcher finds.

    A place at an end of the search has a neighbour on one side only, and so no sub-pixels; most
    matchers drop it. The places between reach half a pixel to either side.
    """
    first = matcher.min_disparity
    return first + 0.5, first + matcher.num_disparities - 1.5


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
    if other.dtype != np.uint8:
        other = np.clip(np.rint(other), 0, 255).astype(np.uint8)
    # Column x of `other` goes to column x + start - first.
    return a, columns_of(other, first - start, total), start


def columns_of(image: np.ndarray, begin: int, count: int) -> np.ndarray:
    """Columns begin .. begin + count - 1 of an image, 0 where it has none."""
    out = np.zeros((image.shape[0], count), dtype=image.dtype)
    low, high = max(0, begin), min(image.shape[1], begin + count)
    if high > low:
        out[:, low - begin : high - begin] = image[:, low:high]
    return out


def opencv_disparity(
    matcher: Any, image: np.ndarray, other: np.ndarray, first: int, margin: int, missing: float
) -> tuple[np.ndarray, np.ndarray, tuple]:
    """What OpenCV's StereoBM or StereoSGBM finds.

    Args:
        matcher: OpenCV's, with its range of disparities set.
        image, other, first: as in `Matcher.match`.
        margin: px around, dark.
        missing: largest disparity that counts as none; at least 0 if the search begins there,
            where it is a point at infinity.

    Returns:
        [h, w] float32 disparity in px with NaN; `image` on its dark canvas, and its place there.
    """
    low = matcher.getMinDisparity()
    high = low + matcher.getNumDisparities() - 1
    left, right, start = side_by_side(image, other, first, low, high, margin)
    place = np.s_[:, start : start + image.shape[1]]
    disparity = matcher.compute(left, right)[place].astype(np.float32) / 16
    disparity[disparity <= (missing if low else max(missing, 0))] = np.nan
    return disparity, left, place


def check_search(num_disparities: int) -> None:
    """Check how many disparities OpenCV's matchers search.

    Raises:
        ConfigError: not a positive multiple of 16.
    """
    if num_disparities < 16 or num_disparities % 16:
        raise ConfigError(f"num_disparities must be a multiple of 16, got {num_disparities}")
