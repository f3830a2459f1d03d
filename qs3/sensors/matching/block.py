"""Block matching of two images by the sum of absolute differences: OpenCV's StereoBM."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from qs3.config.checks import check_ranges
from qs3.sensors.matching.base import Match, check_search, opencv_disparity
from qs3.sensors.pixel_status import Reason

STEREOBM_BIAS_PX = 7.5 / 256
"""OpenCV's StereoBM computes 1/256 px, adds 15 and shifts by 4 bits: it rounds up to the
next 1/16 px, which is on average 7.5/256 px too much (modules/calib3d/src/stereobm.cpp)."""


@dataclass(frozen=True)
class StereoBlockMatcher:
    """OpenCV's StereoBM: sum of absolute differences on x-Sobel images, 1/16 px.

    Attributes:
        num_disparities: how many disparities are searched, a multiple of 16.
        block_size: side of the block in px, odd, 5..255.
        texture_threshold, uniqueness_ratio: as in OpenCV.
        remove_bias: subtract STEREOBM_BIAS_PX (the released code does not).
        min_disparity: where the search begins. With 0, a disparity of 0 (a point at infinity)
            counts as no match, as in the released code.
        max_difference_px: matching the other way round must give the same disparity to so many
            px; -1 switches the check off, as in the paper's sensor.
    """

    num_disparities: int = 160
    block_size: int = 19
    texture_threshold: int = 10
    uniqueness_ratio: int = 15
    remove_bias: bool = True
    min_disparity: int = 0
    max_difference_px: int = -1

    def __post_init__(self) -> None:
        check_search(self.num_disparities)
        check_ranges(self, block_size="odd [5, 255]")

    @property
    def steps_per_px(self) -> int:
        """OpenCV's own steps."""
        return 16

    @property
    def reach_px(self) -> int:
        """Half a block and a pixel of the Sobel filter."""
        return self.block_size // 2 + 1

    def match(self, image: np.ndarray, other: np.ndarray, first: int = 0) -> Match:
        """Disparities; see `Matcher.match`."""
        matcher = cv2.StereoBM.create(self.num_disparities, self.block_size)
        matcher.setMinDisparity(self.min_disparity)
        matcher.setTextureThreshold(self.texture_threshold)
        matcher.setUniquenessRatio(self.uniqueness_ratio)
        matcher.setDisp12MaxDiff(self.max_difference_px)
        missing = self.min_disparity - 1  # OpenCV's mark
        disparity, left, place = opencv_disparity(
            matcher, image, other, first, self.block_size, missing
        )
        if self.remove_bias:
            disparity -= np.float32(STEREOBM_BIAS_PX)
        dark = self._texture(left) < self.texture_threshold
        why_not = np.where(dark, np.uint8(Reason.DARK), np.uint8(Reason.UNMATCHED))
        return Match.of(disparity, why_not[place])

    def _texture(self, canvas: np.ndarray) -> np.ndarray:
        """[h, w] float32: what OpenCV compares with texture_threshold.

        The sum over the block of the x-Sobel response, clipped to the pre-filter's cap of 31.
        """
        response = np.abs(np.clip(cv2.Sobel(canvas, cv2.CV_32F, 1, 0), -31, 31))
        size = (self.block_size, self.block_size)
        return cv2.boxFilter(response, cv2.CV_32F, size, normalize=False)
