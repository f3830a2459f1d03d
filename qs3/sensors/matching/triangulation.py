"""From a match to a depth, the same for all sensors that triangulate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from qs3.sensors.matching import Match
from qs3.sensors.matching.filters import PostFilter, Quantiser
from qs3.sensors.optics.visibility import Reason


@dataclass(frozen=True)
class Triangulation:
    """Z = f b / (d + d0), where d0 = f b / Z_reference is 0 for two parallel cameras.

    Attributes:
        focal_px, baseline_m: f and b.
        offset_px: d0.
        min_depth_m, max_depth_m: depths outside are dropped.
    """

    focal_px: float
    baseline_m: float
    offset_px: float
    min_depth_m: float
    max_depth_m: float

    def depth(
        self, match: Match, quantiser: Quantiser, filters: Sequence[PostFilter]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Filter, quantise, triangulate, in this order.

        Returns:
            [h, w] float32 depth in metres with NaN; [h, w] float32 disparity as used, with NaN;
            [h, w] uint8 `Reason`.
        """
        disparity, reason = match.disparity, match.reason
        for post in filters:
            before = np.isfinite(disparity)
            disparity = post.apply(disparity)
            dropped = before & ~np.isfinite(disparity)
            filled = ~before & np.isfinite(disparity)
            reason = np.where(dropped, np.uint8(Reason.FILTERED), reason)
            reason = np.where(filled, np.uint8(Reason.OK), reason)
        disparity = quantiser.apply(disparity)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = disparity / np.float32(self.focal_px * self.baseline_m)
            if self.offset_px:
                inverse = inverse + np.float32(self.offset_px / (self.focal_px * self.baseline_m))
            depth = (1 / inverse).astype(np.float32)
            inside = (depth > self.min_depth_m) & (depth < self.max_depth_m)
        reason = np.where(np.isfinite(disparity) & ~inside, np.uint8(Reason.RANGE), reason)
        depth[~inside] = np.nan
        return depth, disparity, reason.astype(np.uint8)
