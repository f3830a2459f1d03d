"""Semi-global matching of two images by OpenCV's StereoSGBM."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from qs3.config.checks import check_choice, check_ranges
from qs3.errors import ConfigError
from qs3.sensors.matching.base import Match, check_search, opencv_disparity
from qs3.sensors.matching.subpixel import linearised

SGBM_A_FACTOR = 1.0
"""Takes StereoSGBM's locking from 0.19 to 0.13 px and the RMS from 0.15 to 0.09 px (blocks of 5,
any mode, synthetic dots at 16 phases): what the steps of 1/16 px leave."""

_MODES = {
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,
    "hh": cv2.STEREO_SGBM_MODE_HH,
    "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    "hh4": cv2.STEREO_SGBM_MODE_HH4,
}


@dataclass(frozen=True)
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

    num_disparities: int = 160
    min_disparity: int = 0
    block_size: int = 5
    p1: int | None = None
    p2: int | None = None
    pre_filter_cap: int = 31
    uniqueness_ratio: int = 10
    max_difference_px: int = 1
    mode: str = "sgbm"
    remove_bias: bool = True
    a_factor: float = SGBM_A_FACTOR

    def __post_init__(self) -> None:
        check_search(self.num_disparities)
        check_ranges(self, block_size="odd [1, 31]", a_factor="[-1, 1]")
        check_choice("mode", self.mode, tuple(_MODES))
        small, large = self.penalties
        if not 0 < small < large:
            raise ConfigError(f"penalties must satisfy 0 < p1 < p2, got {small} and {large}")

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
