"""Matching by normalised correlation."""

from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge

from qs3.sensors.matching.base import Match
from qs3.sensors.optics.visibility import Reason, first_reason
from qs3.utils.settings import IsOdd, settings


@settings
class ReferenceMatcher:
    """Normalised correlation over a square window, winner takes all, as in Kinect v1.

    A parabola goes through the best score and its two neighbours. Gain and offset of the
    images do not matter. Of Kinect v1 Konolige and Mihelich (ROS, kinect_calibration/technical)
    give a 9 x 9 or 9 x 7 window, 64 px of search and 1/8 px.

    Attributes:
        window_px: side of the window, odd.
        min_disparity, num_disparities: search range in px.
        steps_per_px: quantiser of the matcher itself; 0 is none.
        min_score: matches with a lower correlation are dropped.
        uniqueness: the best score beats every score more than 2 px away by this much.
    """

    window_px: Annotated[int, Ge(3), IsOdd] = 9
    min_disparity: int = -24
    num_disparities: Annotated[int, Ge(3)] = 64
    steps_per_px: Annotated[int, Ge(0)] = 8
    min_score: float = 0.35
    uniqueness: float = 0.04

    @property
    def reach_px(self) -> int:
        """Half a window."""
        return self.window_px // 2

    def match(self, image: np.ndarray, other: np.ndarray, first: int = 0) -> Match:
        """Disparities; see `Matcher.match`."""
        from qs3.sensors.matching.numba_kernels import best_and_second

        scores = self._scores(image, other.astype(np.float32, copy=False), first)
        last = len(scores) - 1
        best = np.empty(image.shape, dtype=np.int32)
        top, lower, upper, second = beside = np.empty((4, *image.shape), dtype=np.float32)
        best_and_second(scores, best, beside)
        inner = (best > 0) & (best < last)
        unique = top - second >= self.uniqueness
        valid = inner & (top >= self.min_score) & unique

        curvature = np.maximum(2 * top - lower - upper, np.float32(1e-6))
        disparity = self.min_disparity + best + (upper - lower) / (2 * curvature)
        if self.steps_per_px:
            disparity = np.rint(disparity * self.steps_per_px) / self.steps_per_px
        causes = {
            Reason.OUTSIDE: top <= -1,
            Reason.UNMATCHED: top < self.min_score,
            Reason.AMBIGUOUS: inner & ~unique,
        }
        why_not = first_reason(causes, Reason.UNMATCHED)
        return Match.of(np.where(valid, disparity, np.nan).astype(np.float32), why_not)

    def _scores(self, image: np.ndarray, reference: np.ndarray, first: int) -> np.ndarray:
        """[num_disparities, h, w] float32 normalised correlation; -1 outside the reference."""
        from qs3.sensors.matching.numba_kernels import to_correlation

        size = (self.window_px, self.window_px)
        height, width = image.shape
        whole = reference.shape[1]

        def mean(array: np.ndarray) -> np.ndarray:
            return cv2.boxFilter(array, cv2.CV_32F, size, borderType=cv2.BORDER_REFLECT_101)

        def spread(array: np.ndarray, average: np.ndarray) -> np.ndarray:
            variance = mean(array * array) - average * average
            return np.sqrt(np.maximum(variance, np.float32(1e-3)))

        grey = image.astype(np.float32)
        mean_i = mean(grey)
        spread_i = spread(grey, mean_i)
        mean_r = mean(reference)
        spread_r = spread(reference, mean_r)

        scores = np.empty((self.num_disparities, height, width), dtype=np.float32)
        for k, score in enumerate(scores):
            # Column c meets column first + c - disparity of the other image.
            start = first - (self.min_disparity + k)
            low, high = max(0, -start), min(width, whole - start)
            if high - low < self.window_px:
                score[:] = -1
                continue
            score[:, :low], score[:, high:] = -1, -1
            here, there = slice(low, high), slice(start + low, start + high)
            product = mean(grey[:, here] * reference[:, there])
            means = mean_i[:, here], mean_r[:, there]
            spreads = spread_i[:, here], spread_r[:, there]
            to_correlation(product, *means, *spreads, score[:, here])
        return scores
