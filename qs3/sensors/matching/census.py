"""Matching by the order of grey values: census strings, semi-global paths.

Semi-global aggregation (Hirschmueller, PAMI 2008, section 2.3): along a path r, with p the pixel
before on it,

    L(d) = C(d) + min(L_p(d), L_p(d - 1) + P1, L_p(d + 1) + P1, min L_p + P2) - min L_p

and the sum of L over all paths takes the place of C.
"""

from typing import Annotated, Literal

import cv2
import numpy as np
from annotated_types import Ge, Interval

from qs3.sensors.matching.base import (
    Match,
    TextureOverNoise,
    columns_of,
    linearised,
    offset,
    window_moments,
)
from qs3.sensors.optics.visibility import Reason, first_reason
from qs3.utils.settings import IsOdd, NotNegative, settings


def census(image: np.ndarray, window_px: int) -> np.ndarray:
    """Which pixels of the window around a pixel are brighter than it.

    Zabih and Woodfill, Non-parametric local transforms, ECCV 1994, section 3. The border is
    mirrored.

    Args:
        image: [h, w] uint8 or float32.
        window_px: side of the window, odd.

    Returns:
        [n, h, w] uint64, as few as hold window_px ** 2 - 1 bits.
    """
    from qs3.sensors.matching.numba_kernels import census_bits

    half = window_px // 2
    padded = cv2.copyMakeBorder(image, half, half, half, half, cv2.BORDER_REFLECT_101)
    words = np.zeros((-(-(window_px**2 - 1) // 64), *image.shape), dtype=np.uint64)
    census_bits(padded, half, words)
    return words


@settings
class CensusMatcher:
    """Hamming distances of census strings, semi-global, checked both ways, with sub-pixels.

    Gain and offset of the images do not matter. The parts are those that the public settings of
    RealSense D400 cameras name (librealsense, rs_advanced_mode_command.h): census 9 x 9, scan-line
    optimisation, second peak, left-right agreement, linearised sub-pixels. The semi-global sums
    choose the whole disparity; sub-pixels come from the costs before that, because penalties
    between neighbours pull them to whole pixels.

    Attributes:
        num_disparities: how many whole disparities are searched, 3..512.
        min_disparity: where the search begins.
        window_px: side of the census window, odd, 3..15.
        block_px: side of the block over which costs are summed, odd; 1 is none. It sets the
            noise: on synthetic dots the RMS is 0.24 px (1), 0.09 (5), 0.06 (7).
        small_step, large_step: P1 and P2 in bits.
        paths: 4; 0 chooses by block costs alone.
        uniqueness_percent: every other cost but the neighbours' is more than this above the
            best.
        max_difference_px: how far the whole disparities found from `image` and from `other` may
            be apart; -1 switches the check off.
        min_texture: standard deviation of the grey values that the census window needs.
        texture: what it needs relative to the camera's noise; null asks for nothing more.
        a_factor: see `linearised`.
    """

    num_disparities: Annotated[int, Interval(ge=3, le=512)] = 64
    min_disparity: int = 0
    window_px: Annotated[int, Interval(ge=3, le=15), IsOdd] = 9
    block_px: Annotated[int, Ge(1), IsOdd] = 7
    small_step: NotNegative = 6.0
    large_step: NotNegative = 40.0
    paths: Literal[0, 4] = 4
    uniqueness_percent: NotNegative = 5.0
    max_difference_px: int = 1
    min_texture: NotNegative = 2.0
    texture: TextureOverNoise | None = None
    a_factor: Annotated[float, Interval(ge=-1, le=1)] = 0.03

    def __post_init__(self) -> None:
        assert self.small_step <= self.large_step, "small_step must not be above large_step"
        assert self._worst * self.block_px**2 < 1 << 16, "costs of a block exceed 16 bits"

    @property
    def reach_px(self) -> int:
        """Half a census window and half a block; path costs fade out farther away."""
        return self.window_px // 2 + self.block_px // 2

    @property
    def _worst(self) -> int:
        """Largest cost of a pixel; also that of places outside the other image."""
        return self.window_px**2 - 1

    def match(self, image: np.ndarray, other: np.ndarray, first: int = 0) -> Match:
        """Disparities; see `Matcher.match`."""
        from qs3.sensors.matching import numba_kernels

        height, width = image.shape
        count = self.num_disparities
        # Place j of the volumes is disparity most - j: pixel u meets column begin + u + j.
        most = self.min_disparity + count - 1
        begin = first - most
        cost = self._cost(image, other, begin)
        total = self._aggregated(cost)

        best = np.empty(image.shape, dtype=np.int32)
        below, here, above, top, second = beside = np.empty((5, *image.shape), dtype=np.float32)
        other_best = np.empty((height, width + count - 1), dtype=np.int32)
        numba_kernels.cheapest(total, cost, best, beside, other_best)
        disparity = most - best - linearised(offset(below, here, above), self.a_factor)

        columns = begin + np.arange(width) + best
        within = (columns >= 1) & (columns < other.shape[1] - 1)
        mean, variance = window_moments(image, self.window_px)
        textured = np.sqrt(variance) >= self.min_texture
        if self.texture is not None:
            textured &= self.texture.enough(mean, variance)
        inner = (best > 0) & (best < count - 1)
        consistent = np.ones_like(inner)
        if self.max_difference_px >= 0:
            back = np.take_along_axis(other_best, np.arange(width) + best, axis=1)
            consistent = np.abs(back - best) <= self.max_difference_px
        unique = second > top * np.float32(1 + self.uniqueness_percent / 100)

        valid = within & textured & inner & unique & consistent
        causes = {
            Reason.OUTSIDE: ~within,
            Reason.DARK: ~textured,
            Reason.AMBIGUOUS: inner & ~unique,
            Reason.INCONSISTENT: inner & ~consistent,
        }
        why_not = first_reason(causes, Reason.UNMATCHED)
        return Match.of(np.where(valid, disparity, np.nan).astype(np.float32), why_not)

    def _cost(self, image: np.ndarray, other: np.ndarray, begin: int) -> np.ndarray:
        """[h, w, D] uint16 cost summed over the block; place [v, u, j] is column begin + u + j."""
        from qs3.sensors.matching import numba_kernels

        height, width = image.shape
        count = self.num_disparities
        length = width + count - 1
        words, others = census(image, self.window_px), census(other, self.window_px)
        others = np.stack([columns_of(word, begin, length) for word in others])
        cost = np.empty((height, width, count), dtype=np.uint16)
        ends = -begin, other.shape[1] - begin
        half = self.block_px // 2
        numba_kernels.block_costs(words, others, *ends, np.uint16(self._worst), half, cost)
        return cost

    def _aggregated(self, cost: np.ndarray) -> np.ndarray:
        """[h, w, D] uint16 that choose the disparity."""
        from qs3.sensors.matching import numba_kernels

        if not self.paths:
            return cost
        area = self.block_px**2
        # As many bits are dropped as the sum over all paths needs to fit 16.
        largest = int(self.paths * area * (self._worst + self.large_step))
        drop = max(0, largest.bit_length() - 16)
        steps = (round(step * area) >> drop for step in (self.small_step, self.large_step))
        total = np.empty_like(cost)
        numba_kernels.path_sums(cost, np.uint16(drop), *map(np.uint16, steps), total)
        return total
