"""Block matching of two images by the sum of absolute differences: OpenCV's StereoBM."""

from __future__ import annotations

from typing import Annotated, Literal

import cv2
import numpy as np
from annotated_types import Ge, Interval, MultipleOf

from qs3.sensors.matching.base import Match, linearised, opencv_disparity
from qs3.sensors.optics.visibility import Reason
from qs3.utils.settings import IsOdd, settings

_Search = Annotated[int, Ge(16), MultipleOf(16)]

STEREOBM_BIAS_PX = 7.5 / 256
"""OpenCV's StereoBM computes 1/256 px, adds 15 and shifts by 4 bits: it rounds up to the
next 1/16 px, which is on average 7.5/256 px too much (modules/calib3d/src/stereobm.cpp)."""


@settings
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

    num_disparities: _Search = 160
    block_size: Annotated[int, Interval(ge=5, le=255), IsOdd] = 19
    texture_threshold: int = 10
    uniqueness_ratio: int = 15
    remove_bias: bool = True
    min_disparity: int = 0
    max_difference_px: int = -1

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


SGBM_A_FACTOR = 1.0
"""Takes StereoSGBM's locking from 0.19 to 0.13 px and the RMS from 0.15 to 0.09 px (blocks of 5,
any mode, synthetic dots at 16 phases): what the steps of 1/16 px leave."""

_MODES = {
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,
    "hh": cv2.STEREO_SGBM_MODE_HH,
    "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    "hh4": cv2.STEREO_SGBM_MODE_HH4,
}


@settings
class SemiGlobalMatcher:
    """OpenCV's StereoSGBM: Birchfield-Tomasi costs, aggregated along paths, 1/16 px.

    Smoother than block matching: it carries disparities into weakly textured areas.

    Attributes:
        num_disparities: how many disparities are searched, a multiple of 16.
        min_disparity: where the search begins.
        block_size: side of the block in px, odd, 1..31.
        p1, p2: penalties for a change by one and by more disparities; null: 8 and 32 times
            block_size ** 2, as OpenCV advises for grey images.
        pre_filter_cap: the x-Sobel response is clipped to this.
        uniqueness_ratio: in percent, as in OpenCV.
        max_difference_px: matching the other way round must agree to so many px; -1: off.
        mode: sgbm (5 paths), hh (8 paths), hh4 (4 paths) or 3way.
        remove_bias: undo OpenCV's rounding of sub-pixels, which is towards zero and so 1/16 px
            too much where they are negative, 0.03 px in the mean.
        a_factor: see `linearised`; used with `remove_bias`. 0 leaves the locking, with which
            depths crowd at whole disparities.
    """

    num_disparities: _Search = 160
    min_disparity: int = 0
    block_size: Annotated[int, Interval(ge=1, le=31), IsOdd] = 5
    p1: int | None = None
    p2: int | None = None
    pre_filter_cap: int = 31
    uniqueness_ratio: int = 10
    max_difference_px: int = 1
    mode: Literal["sgbm", "hh", "3way", "hh4"] = "sgbm"
    remove_bias: bool = True
    a_factor: Annotated[float, Interval(ge=-1, le=1)] = SGBM_A_FACTOR

    def __post_init__(self) -> None:
        small, large = self.penalties
        assert 0 < small < large, "penalties must satisfy 0 < p1 < p2"

    @property
    def penalties(self) -> tuple[int, int]:
        """P1 and P2 as used."""
        area = self.block_size**2
        return (8 * area if self.p1 is None else self.p1, 32 * area if self.p2 is None else self.p2)

    @property
    def steps_per_px(self) -> int:
        """OpenCV's own steps; 0 with `remove_bias`, which makes them uneven."""
        return 0 if self.remove_bias else 16

    @property
    def reach_px(self) -> int:
        """Half a block and a pixel of the Sobel filter; the paths carry little beyond."""
        return self.block_size // 2 + 8

    def match(self, image: np.ndarray, other: np.ndarray, first: int = 0) -> Match:
        """Disparities; see `Matcher.match`."""
        small, large = self.penalties
        matcher = cv2.StereoSGBM.create(
            minDisparity=self.min_disparity,
            numDisparities=self.num_disparities,
            blockSize=self.block_size,
            P1=small,
            P2=large,
            disp12MaxDiff=self.max_difference_px,
            preFilterCap=self.pre_filter_cap,
            uniquenessRatio=self.uniqueness_ratio,
            mode=_MODES[self.mode],
        )
        # OpenCV's mark for no match is min_disparity - 1; at the very first disparity the curve
        # through the costs has only one side.
        missing = self.min_disparity - 1 / 16
        disparity, _, _ = opencv_disparity(matcher, image, other, first, self.reach_px, missing)
        if self.remove_bias:
            disparity = self._repaired(disparity)
        return Match.of(disparity)

    def _repaired(self, disparity: np.ndarray) -> np.ndarray:
        """The middle of what OpenCV rounds to each step, and without locking.

        It takes the whole part of 16 x + 1/2, x in -1/2..1/2 (modules/calib3d/src/stereosgbm.cpp).
        The whole part goes towards zero: a negative result n stands for the step before, n - 1,
        and 0 for two steps.
        """
        whole = np.floor((disparity * 16 + 7) / 16)
        steps = disparity * 16 - whole * 16
        phase = (steps - (steps < 0) - np.float32(0.5) * (steps == 0)) / 16
        return (whole + linearised(phase, self.a_factor)).astype(np.float32)
