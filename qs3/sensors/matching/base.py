"""What a matcher is asked for and gives back: exchangeable in every sensor that matches."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from qs3.sensors.optics.infrared import GreyNoise
from qs3.sensors.optics.visibility import Reason
from qs3.utils.settings import Positive, settings


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


@runtime_checkable
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


def columns_of(image: np.ndarray, begin: int, count: int) -> np.ndarray:
    """Columns begin .. begin + count - 1 of an image, 0 where it has none."""
    out = np.zeros((image.shape[0], count), dtype=image.dtype)
    low, high = max(0, begin), min(image.shape[1], begin + count)
    if high > low:
        out[:, low - begin : high - begin] = image[:, low:high]
    return out


def offset(lower: np.ndarray, best: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Position of the minimum, -0.5..0.5 px from the best towards `upper`; float32.

    By two lines of equal and opposite slope through three float32 costs that grow linearly
    (absolute differences, Hamming distances). Shimizu and Okutomi, IJCV 2005, section 2. 0 where
    all three are the same; where `best` is not the lowest, as costs before aggregation may be, the
    nearer end.
    """
    width = 2 * (np.maximum(lower, upper) - best)
    half = np.float32(0.5)
    return np.clip((lower - upper) / np.maximum(width, np.float32(1e-6)), -half, half)


def linearised(phase: np.ndarray, a_factor: float) -> np.ndarray:
    """Undo the pull towards (or away from) whole pixels that a fit has: pixel locking.

    An odd map that keeps -0.5, 0 and 0.5: x + a sin(2 pi x) / (2 pi), with one number for a
    fit and a cost, as the "A-factor" of RealSense D400 cameras (Intel, Subpixel linearity
    improvement; its formula is not published, this one is ours).

    Args:
        phase: from `offset`.
        a_factor: -1..1; > 0 where values crowd at whole pixels, < 0 where at halves.
    """
    if not a_factor:
        return phase
    turn = np.float32(2 * np.pi)
    return phase + np.float32(a_factor) / turn * np.sin(turn * phase)


@settings
class TextureOverNoise:
    """A window is textured if it varies more than the camera's noise lets a flat one vary.

    In contrast to a threshold in grey values it asks no more of a dim or a dull picture than of a
    bright one.

    Attributes:
        ratio: standard deviation of the texture over that of the noise. In 9 x 9 pixels of noise
            alone the two are mistaken for each other up to a ratio of about 0.6.
        noise: of the picture, at each window's mean grey value; sensors set it for each picture
            (`for_picture`).
    """

    ratio: Positive = 0.7
    noise: GreyNoise | None = None

    def enough(self, mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """[h, w] bool from the mean and the variance of the grey values of each window."""
        assert self.noise is not None, "a camera without noise takes texture=null"
        return variance >= (1 + self.ratio**2) * self.noise.variance(mean)


def for_picture(matcher: Matcher, noise: GreyNoise) -> Matcher:
    """The matcher for pictures with this noise; itself, if it has no `texture` that asks."""
    texture = getattr(matcher, "texture", None)
    if texture is None:
        return matcher
    return replace(matcher, texture=replace(texture, noise=noise))  # type: ignore[type-var]


def window_moments(image: np.ndarray, window_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance [h, w] float32 of the grey values in the window around each pixel."""
    grey = image.astype(np.float32)
    size, border = (window_px, window_px), cv2.BORDER_REFLECT_101
    mean = cv2.boxFilter(grey, cv2.CV_32F, size, borderType=border)
    square = cv2.boxFilter(grey * grey, cv2.CV_32F, size, borderType=border)
    return mean, np.maximum(square - mean * mean, 0)
