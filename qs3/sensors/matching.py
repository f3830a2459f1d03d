"""From images to disparity: block matching of a stereo pair, and against a reference image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from qs3.errors import ConfigError

STEREOBM_BIAS_PX = 7.5 / 256
"""OpenCV's StereoBM computes 1/256 px, adds 15 and shifts by 4 bits: it rounds up to the
next 1/16 px, which is on average 7.5/256 px too much (modules/calib3d/src/stereobm.cpp)."""


@dataclass(frozen=True)
class StereoBlockMatcher:
    """OpenCV's StereoBM: sum of absolute differences on x-Sobel images, 1/16 px.

    Attributes:
        num_disparities: search range 0..num_disparities-1 px, a multiple of 16.
        block_size: side of the block in px, odd, 5..255.
        texture_threshold, uniqueness_ratio: as in OpenCV.
        remove_bias: subtract STEREOBM_BIAS_PX (the released code does not).
    """

    num_disparities: int = 160
    block_size: int = 19
    texture_threshold: int = 10
    uniqueness_ratio: int = 15
    remove_bias: bool = True

    def __post_init__(self) -> None:
        if self.num_disparities < 16 or self.num_disparities % 16:
            raise ConfigError(
                f"num_disparities must be a positive multiple of 16, got {self.num_disparities}"
            )
        if self.block_size % 2 == 0 or not 5 <= self.block_size <= 255:
            raise ConfigError(f"block_size must be odd and in 5..255, got {self.block_size}")

    def match(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Disparity of the left image.

        Args:
            left, right: [h, w] uint8, rectified. The first num_disparities +
                block_size / 2 columns can get no value: pad on the left.

        Returns:
            [h, w] float32 in px, NaN where there is no match. Zero disparity (a point at
            infinity) counts as no match, as in the released code.
        """
        matcher = cv2.StereoBM.create(self.num_disparities, self.block_size)
        matcher.setTextureThreshold(self.texture_threshold)
        matcher.setUniquenessRatio(self.uniqueness_ratio)
        disparity = matcher.compute(left, right).astype(np.float32) / 16
        disparity[disparity <= 0] = np.nan
        if self.remove_bias:
            disparity -= np.float32(STEREOBM_BIAS_PX)
        return disparity


@dataclass(frozen=True)
class ReferenceMatcher:
    """One camera against a stored image of the pattern, as in Kinect v1.

    Normalised correlation over a square window, winner takes all, a parabola through the
    best score and its neighbours, and the device's quantiser. Konolige and Mihelich (ROS,
    kinect_calibration/technical) give a 9 x 9 or 9 x 7 window, 64 px of search and 1/8 px.

    Attributes:
        window_px: side of the window, odd.
        min_disparity, num_disparities: search range in px, relative to the reference.
        steps_per_px: quantiser; 8 is 1/8 px, 0 switches it off.
        min_score: matches with a lower correlation are dropped.
        uniqueness: the best score beats every score more than 2 px away by this much.
    """

    window_px: int = 9
    min_disparity: int = -24
    num_disparities: int = 64
    steps_per_px: int = 8
    min_score: float = 0.35
    uniqueness: float = 0.04

    def __post_init__(self) -> None:
        if self.window_px % 2 == 0 or self.window_px < 3:
            raise ConfigError(f"window_px must be odd and >= 3, got {self.window_px}")
        if self.num_disparities < 3:
            raise ConfigError(f"num_disparities must be >= 3, got {self.num_disparities}")

    def match(self, image: np.ndarray, reference: np.ndarray, left: int) -> np.ndarray:
        """Disparity of a part of the camera's image.

        Args:
            image: [h, w] uint8, rows of the whole image's rows that `reference` holds too.
            reference: [h, W] float32, the same rows of the stored image, whole width.
            left: column of the whole image at which `image` starts.

        Returns:
            [h, w] float32: u - u_reference in px, NaN where there is no match.
        """
        scores = self._scores(image, reference, left)
        last = len(scores) - 1
        best = scores.argmax(axis=0)

        def score_at(index: np.ndarray) -> np.ndarray:
            return np.take_along_axis(scores, index[None], axis=0)[0]

        top = score_at(best)
        lower, upper = score_at(np.maximum(best - 1, 0)), score_at(np.minimum(best + 1, last))
        # The runner-up: blank the winner's neighbourhood and look again.
        for near in range(-2, 3):
            np.put_along_axis(scores, np.clip(best + near, 0, last)[None], -1, axis=0)
        second = scores.max(axis=0)
        inner = (best > 0) & (best < last)
        valid = inner & (top >= self.min_score) & (top - second >= self.uniqueness)

        curvature = np.maximum(2 * top - lower - upper, np.float32(1e-6))
        disparity = self.min_disparity + best + (upper - lower) / (2 * curvature)
        if self.steps_per_px:
            disparity = np.rint(disparity * self.steps_per_px) / self.steps_per_px
        return np.where(valid, disparity, np.nan).astype(np.float32)

    def _scores(self, image: np.ndarray, reference: np.ndarray, left: int) -> np.ndarray:
        """[num_disparities, h, w] float32 normalised correlation; -1 outside the reference."""
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

        scores = np.full((self.num_disparities, height, width), -1, dtype=np.float32)
        for k in range(self.num_disparities):
            # Column c of the part is u = left + c; it is compared with u - disparity.
            start = left - (self.min_disparity + k)
            first, last = max(0, -start), min(width, whole - start)
            if last - first < self.window_px:
                continue
            here = slice(first, last)
            there = slice(start + first, start + last)
            product = mean(grey[:, here] * reference[:, there])
            covariance = product - mean_i[:, here] * mean_r[:, there]
            scores[k, :, here] = covariance / (spread_i[:, here] * spread_r[:, there])
        return scores
