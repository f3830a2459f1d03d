"""Block matching of two images by the sum of absolute differences: OpenCV's StereoBM."""

from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge, Interval, MultipleOf

from qs3.sensors.matching.base import Match, columns_of
from qs3.sensors.optics.visibility import Reason
from qs3.utils.settings import IsOdd, settings

# OpenCV's StereoBM computes 1/256 px, adds 15 and shifts by 4 bits: it rounds up to the
# next 1/16 px, which is on average 7.5/256 px too much (modules/calib3d/src/stereobm.cpp).
_BIAS_PX = 7.5 / 256


@settings
class StereoBlockMatcher:
    """OpenCV's StereoBM: sum of absolute differences on x-Sobel images, 1/16 px.

    Attributes:
        num_disparities: how many disparities are searched, a multiple of 16.
        block_size: side of the block in px, odd, 5..255.
        texture_threshold, uniqueness_ratio: as in OpenCV.
        remove_bias: subtract the 7.5/256 px by which StereoBM is off (the released code
            does not).
        min_disparity: where the search begins. With 0, a disparity of 0 (a point at infinity)
            counts as no match, as in the released code.
        max_difference_px: matching the other way round must give the same disparity to so many
            px; -1 switches the check off, as in the paper's sensor.
    """

    num_disparities: Annotated[int, Ge(16), MultipleOf(16)] = 160
    block_size: Annotated[int, Interval(ge=5, le=255), IsOdd] = 19
    texture_threshold: int = 10
    uniqueness_ratio: int = 15
    remove_bias: bool = True
    min_disparity: int = 0
    max_difference_px: int = -1

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
        # OpenCV wants images of one size: both go on dark canvases with room for the search.
        low, high = self.min_disparity, self.min_disparity + self.num_disparities - 1
        start, width = self.block_size + max(high, 0), image.shape[1]
        total = start + width + self.block_size + max(-low, 0)
        if other.dtype != np.uint8:
            other = np.clip(np.rint(other), 0, 255).astype(np.uint8)
        left, right = columns_of(image, -start, total), columns_of(other, first - start, total)
        place = np.s_[:, start : start + width]
        disparity = matcher.compute(left, right)[place].astype(np.float32) / 16
        disparity[disparity <= (low - 1 if low else 0)] = np.nan  # OpenCV's mark
        if self.remove_bias:
            disparity -= np.float32(_BIAS_PX)
        # What OpenCV compares: the sum over the block of the x-Sobel response, clipped to the
        # pre-filter's cap of 31.
        response = np.abs(np.clip(cv2.Sobel(left, cv2.CV_32F, 1, 0), -31, 31))
        size = (self.block_size, self.block_size)
        texture = cv2.boxFilter(response, cv2.CV_32F, size, normalize=False)
        dark = texture < self.texture_threshold
        why_not = np.where(dark, np.uint8(Reason.DARK), np.uint8(Reason.UNMATCHED))
        return Match.of(disparity, why_not[place])
