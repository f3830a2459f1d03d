"""Matching by the order of grey values: census strings and semi-global aggregation."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided, sliding_window_view

from qs3.config.checks import check_ranges
from qs3.errors import ConfigError
from qs3.sensors.matching.base import Match, columns_of
from qs3.sensors.matching.hamming import census, count_ones
from qs3.sensors.matching.semiglobal import aggregate
from qs3.sensors.matching.subpixel import Fit, linearised, offset
from qs3.sensors.matching.texture import TextureOverNoise, window_moments
from qs3.sensors.pixel_status import Reason, first_reason

A_FACTORS = {Fit.V: 0.03, Fit.PARABOLA: 0.57}
"""What `linearised` needs for Hamming distances over blocks, without grey values: measured on
synthetic dots over 16 phases (tests/sensors/matching/test_census.py)."""


@dataclass(frozen=True)
class CensusMatcher:
    """Hamming distances of census strings, semi-global, checked both ways, with sub-pixels.

    The census string of a pixel says which pixels of the window around it are brighter than
    it, so gain and offset of the images do not matter. The parts are those that the public
    settings of RealSense D400 cameras name (librealsense, rs_advanced_mode_command.h): census
    9 x 9 and absolute difference, scan-line optimisation with penalties that depend on the
    image, second peak, left-right agreement, linearised sub-pixels.

    The semi-global sums choose the whole disparity; sub-pixels come from the costs before that,
    because penalties between neighbours pull them to whole pixels. Measured on synthetic dots
    at 16 phases, block 7: bias at most 0.015 px and an RMS of 0.03 to 0.06 px; from the path
    sums the bias is 0.10 px (V) to 0.19 px (parabola).

    Attributes:
        num_disparities: how many whole disparities are searched, 3..512.
        min_disparity: where the search begins.
        window_px: side of the census window, odd, 3..15.
        block_px: side of the block over which costs are summed, odd; 1 is none. It sets the
            noise: on the same dots the RMS is 0.24 px (1), 0.09 (5), 0.06 (7).
        difference_weight: cost of one grey value of difference, in bits; 0 leaves them out.
            They make no sense against a stored image of the pattern.
        difference_cap: larger differences of grey values cost no more.
        small_step, large_step: P1 and P2 in bits.
        paths: 4 or 8; 0 chooses by block costs alone.
        edge_grey: difference of grey values at which P2 is halved; 0 is off.
        uniqueness_percent: every other cost but the neighbours' is more than this above the
            best.
        max_difference_px: how far the whole disparities found from `image` and from `other` may
            be apart; -1 switches the check off.
        min_texture: standard deviation of the grey values that the census window needs.
        texture: what it needs relative to the camera's noise; null asks for nothing more.
        fit: curve through three costs.
        a_factor: see `linearised`; null is the measured one of the fit.
        path_phase: take sub-pixels from the path sums, with the locking said above.
    """

    num_disparities: int = 64
    min_disparity: int = 0
    window_px: int = 9
    block_px: int = 7
    difference_weight: float = 0.0
    difference_cap: int = 30
    small_step: float = 6.0
    large_step: float = 40.0
    paths: int = 8
    edge_grey: float = 0.0
    uniqueness_percent: float = 5.0
    max_difference_px: int = 1
    min_texture: float = 2.0
    texture: TextureOverNoise | None = None
    fit: Fit = Fit.V
    a_factor: float | None = None
    path_phase: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "fit", Fit.of(self.fit))
        check_ranges(self, num_disparities="[3, 512]", window_px="odd [3, 15]", block_px="odd >= 1")
        if self.paths not in (0, 4, 8):
            raise ConfigError(f"paths must be 0, 4 or 8, got {self.paths}")
        if not 0 <= self.small_step <= self.large_step:
            raise ConfigError(
                "small_step and large_step must satisfy 0 <= small_step <= large_step, got "
                f"{self.small_step} and {self.large_step}"
            )
        grey = ("difference_weight", "difference_cap", "edge_grey", "min_texture")
        check_ranges(self, **dict.fromkeys(grey, ">= 0"))
        check_ranges(self, uniqueness_percent=">= 0", a_factor="[-1, 1]")
        if self._worst * self.block_px**2 > 65535:
            raise ConfigError(
                f"block_px {self.block_px} with costs up to {self._worst} a pixel exceeds 16 "
                "bits: lower block_px, window_px or difference_weight"
            )

    @property
    def reach_px(self) -> int:
        """Half a census window and half a block; path costs fade out farther away."""
        return self.window_px // 2 + self.block_px // 2

    @property
    def _worst(self) -> int:
        """Largest cost of a pixel; also that of places outside the other image."""
        return self.window_px**2 - 1 + round(self.difference_weight * min(self.difference_cap, 255))

    def match(self, image: np.ndarray, other: np.ndarray, first: int = 0) -> Match:
        """Disparities; see `Matcher.match`."""
        height, width = image.shape
        count = self.num_disparities
        # Place j of the volumes is disparity most - j: pixel u meets column begin + u + j.
        most = self.min_disparity + count - 1
        begin = first - most
        cost = self._cost(image, other, begin)
        total = self._aggregated(cost, image)

        best = total.argmin(axis=2)
        row_of_costs = np.arange(height * width).reshape(height, width) * count

        def at(volume: np.ndarray, step: int) -> np.ndarray:
            place = np.clip(best + step, 0, count - 1)
            return volume.reshape(-1)[row_of_costs + place].astype(np.float32)

        source = total if self.path_phase else cost
        phase = offset(at(source, -1), at(source, 0), at(source, 1), self.fit)
        a_factor = A_FACTORS[self.fit] if self.a_factor is None else self.a_factor
        disparity = most - best - linearised(phase, a_factor)

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
        grey = columns_of(other, begin, length)
        if grey.dtype != np.uint8:
            grey = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        capped = np.minimum(np.arange(256), self.difference_cap)
        difference = np.rint(self.difference_weight * capped).astype(np.uint16)

        cost = np.empty((height, width, count), dtype=np.uint16)
        for row in range(height):  # a row of all places fits a cache
            bits = np.zeros((width, count), dtype=np.uint8)
            for a, b in zip(words, others, strict=True):
                bits += count_ones(a[row][:, None] ^ sliding_window_view(b[row], count))
            cost[row] = bits
            if self.difference_weight:
                a_grey, b_grey = image[row][:, None], sliding_window_view(grey[row], count)
                cost[row] += difference[np.maximum(a_grey, b_grey) - np.minimum(a_grey, b_grey)]
        columns = np.arange(begin, begin + length)
        missing = sliding_window_view((columns < 0) | (columns >= other.shape[1]), count)
        if missing.any():
            np.copyto(cost, np.uint16(self._worst), where=missing)
        if self.block_px == 1:
            return cost
        size = (self.block_px, self.block_px)
        border = cv2.BORDER_REFLECT_101
        return cv2.boxFilter(cost, cv2.CV_16U, size, normalize=False, borderType=border)

    def _aggregated(self, cost: np.ndarray, image: np.ndarray) -> np.ndarray:
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
            self.paths,
            image,
            self.edge_grey,
        )


def _best_of_other(total: np.ndarray) -> np.ndarray:
    """Best place of each pixel of the other image, from the same costs.

    `total` is [h, w, D]; place [v, u, j] is column u + j of the other image.

    Returns:
        [h, w + D - 1] place j of the lowest total[v, x - j, j] for each column x.
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
