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
from numpy.lib.stride_tricks import as_strided, sliding_window_view

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


def census(image: np.ndarray, window_px: int) -> list[np.ndarray]:
    """Which pixels of the window around a pixel are brighter than it.

    Zabih and Woodfill, Non-parametric local transforms, ECCV 1994, section 3. The border is
    mirrored.

    Args:
        image: [h, w] uint8 or float32.
        window_px: side of the window, odd.

    Returns:
        Arrays [h, w] of unsigned integers, as few and as narrow as hold window_px ** 2 - 1 bits.
    """
    half = window_px // 2
    height, width = image.shape
    padded = cv2.copyMakeBorder(image, half, half, half, half, cv2.BORDER_REFLECT_101)
    around = [divmod(k, window_px) for k in range(window_px**2)]
    around.remove((half, half))
    planes = np.zeros((-(-len(around) // 8), height, width), dtype=np.uint8)
    for bit, (dy, dx) in enumerate(around):
        brighter = padded[dy : dy + height, dx : dx + width] > image
        planes[bit // 8] |= brighter.view(np.uint8) << np.uint8(bit % 8)
    words = []
    while len(planes):
        size = min(8, 1 << (len(planes) - 1).bit_length())
        word = np.zeros((height, width, size), dtype=np.uint8)
        part = planes[:size]
        word[..., : len(part)] = part.transpose(1, 2, 0)
        words.append(word.view(f"u{size}")[..., 0])
        planes = planes[size:]
    return words


def count_ones(words: np.ndarray) -> np.ndarray:
    """Number of set bits of unsigned integers, as uint8.

    Neighbouring bits are added, then pairs, then fours, then all bytes by one multiplication
    (Warren, Hacker's Delight, section 5-1): no table, and vectorised.
    """
    kind = words.dtype.type
    bits = 8 * words.dtype.itemsize
    full = (1 << bits) - 1
    every_second, pairs, fours = (kind(full // d) for d in (3, 5, 17))
    x = words - ((words >> kind(1)) & every_second)
    y = (x >> kind(2)) & pairs
    x &= pairs
    x += y
    np.right_shift(x, kind(4), out=y)
    x += y
    x &= fours
    if bits > 8:
        x *= kind(full // 255)
        x >>= kind(bits - 8)
    return x.astype(np.uint8)


STRIP_ROWS = 64
"""Rows that are turned at a time for the horizontal paths: some MB, which a cache holds."""


def aggregate(cost: np.ndarray, small: int, large: int) -> np.ndarray:
    """Sum of the path costs along rows and columns, both ways.

    Args:
        cost: [h, w, D] uint16; 4 * (largest cost + large) must be below 65536.
        small: P1, for a step of one disparity between neighbours.
        large: P2, for any larger step.

    Returns:
        [h, w, D] uint16.
    """
    total = np.zeros_like(cost)
    both_ways = (slice(None), slice(None, None, -1))
    for flip in both_ways:
        _sweep(cost[flip], total[flip], small, large)
    for top in range(0, len(cost), STRIP_ROWS):
        rows = slice(top, top + STRIP_ROWS)
        turned = np.ascontiguousarray(cost[rows].transpose(1, 0, 2))
        total_turned = np.zeros_like(turned)
        for flip in both_ways:
            _sweep(turned[flip], total_turned[flip], small, large)
        total[rows] += total_turned.transpose(1, 0, 2)
    return total


def _sweep(cost: np.ndarray, total: np.ndarray, small: int, large: int) -> None:
    """Add to `total` the costs of paths from line to line; both are [lines, places, D] uint16."""
    p1, p2 = np.uint16(small), np.uint16(large)
    # Kept with its minimum at 0, so that min L_p drops out.
    before = np.zeros(cost.shape[1:], dtype=np.uint16)
    best = np.empty_like(before)
    step = np.empty_like(before)
    for i in range(len(cost)):
        np.minimum(before, p2, out=best)
        np.add(before, p1, out=step)
        np.minimum(best[:, 1:], step[:, :-1], out=best[:, 1:])
        np.minimum(best[:, :-1], step[:, 1:], out=best[:, :-1])
        best += cost[i]
        total[i] += best
        np.subtract(best, best.min(axis=1, keepdims=True), out=before)


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
        height, width = image.shape
        count = self.num_disparities
        # Place j of the volumes is disparity most - j: pixel u meets column begin + u + j.
        most = self.min_disparity + count - 1
        begin = first - most
        cost = self._cost(image, other, begin)
        total = self._aggregated(cost)

        best = total.argmin(axis=2)
        row_of_costs = np.arange(height * width).reshape(height, width) * count

        def at(volume: np.ndarray, step: int) -> np.ndarray:
            place = np.clip(best + step, 0, count - 1)
            return volume.reshape(-1)[row_of_costs + place].astype(np.float32)

        phase = offset(at(cost, -1), at(cost, 0), at(cost, 1))
        disparity = most - best - linearised(phase, self.a_factor)

        columns = begin + np.arange(width) + best
        within = (columns >= 1) & (columns < other.shape[1] - 1)
        mean, variance = window_moments(image, self.window_px)
        textured = np.sqrt(variance) >= self.min_texture
        if self.texture is not None:
            textured &= self.texture.enough(mean, variance)
        inner = (best > 0) & (best < count - 1)
        consistent = np.ones_like(inner)
        if self.max_difference_px >= 0:
            back = np.take_along_axis(_best_of_other(total), np.arange(width) + best, axis=1)
            consistent = np.abs(back - best) <= self.max_difference_px
        top = at(total, 0)
        for step in (-1, 0, 1):  # blank the winner and look again
            place = np.clip(best + step, 0, count - 1)
            total.reshape(-1)[row_of_costs + place] = np.iinfo(total.dtype).max
        unique = total.min(axis=2) > top * np.float32(1 + self.uniqueness_percent / 100)

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
        height, width = image.shape
        count = self.num_disparities
        length = width + count - 1
        words = census(image, self.window_px)
        others = [columns_of(word, begin, length) for word in census(other, self.window_px)]
        cost = np.empty((height, width, count), dtype=np.uint16)
        for row in range(height):  # a row of all places fits a cache
            bits = np.zeros((width, count), dtype=np.uint8)
            for a, b in zip(words, others, strict=True):
                bits += count_ones(a[row][:, None] ^ sliding_window_view(b[row], count))
            cost[row] = bits
        columns = np.arange(begin, begin + length)
        missing = sliding_window_view((columns < 0) | (columns >= other.shape[1]), count)
        if missing.any():
            np.copyto(cost, np.uint16(self._worst), where=missing)
        if self.block_px == 1:
            return cost
        size = (self.block_px, self.block_px)
        border = cv2.BORDER_REFLECT_101
        return cv2.boxFilter(cost, cv2.CV_16U, size, normalize=False, borderType=border)

    def _aggregated(self, cost: np.ndarray) -> np.ndarray:
        """[h, w, D] uint16 that choose the disparity; never `cost` itself."""
        if not self.paths:
            return cost.copy()
        area = self.block_px**2
        # As many bits are dropped as the sum over all paths needs to fit 16.
        largest = int(self.paths * area * (self._worst + self.large_step))
        drop = max(0, largest.bit_length() - 16)
        return aggregate(
            cost >> np.uint16(drop) if drop else cost,
            round(self.small_step * area) >> drop,
            round(self.large_step * area) >> drop,
        )


def _best_of_other(total: np.ndarray) -> np.ndarray:
    """[h, w + D - 1] place j of the lowest total[v, x - j, j] for each column x of the other image.

    `total` is [h, w, D]; place [v, u, j] is column u + j of the other image.
    """
    height, width, count = total.shape
    out = np.empty((height, width + count - 1), dtype=np.intp)
    padded = np.full((width + 2 * (count - 1), count), np.iinfo(total.dtype).max, dtype=total.dtype)
    row_bytes, place_bytes = padded.strides
    # Element [x, j] of the diagonals is padded[count - 1 + x - j, j].
    diagonals = as_strided(
        padded[count - 1 :], (width + count - 1, count), (row_bytes, place_bytes - row_bytes)
    )
    for row in range(height):
        padded[count - 1 : count - 1 + width] = total[row]
        diagonals.argmin(axis=1, out=out[row])
    return out
