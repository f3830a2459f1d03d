"""The points of somebody's cloud that a camera measured.

Depth cameras write NaN, infinity or (0, 0, 0) for a pixel that saw nothing, the last of these
RealSense's and Azure Kinect's libraries: of an object two metres away such a point is a spike.
"""

from __future__ import annotations

import numpy as np

from qs3.datasets.clouds.finite import measured
from qs3.errors import DataError

NOTHING = "NaN, infinite or (0, 0, 0)"
"""What is left out, for messages."""


def with_depth(cloud: np.ndarray, where: str) -> tuple[np.ndarray, int]:
    """[n, 3] without the points that stand for no measurement, and how many these were.

    One point that is exactly (0, 0, 0) stays: a shape about the origin may have it. Several can
    only stand for nothing, or are one point of a cloud in whole millimetres.

    Raises:
        DataError: no point is left.
    """
    finite, dropped = measured(cloud, where)
    nothing = (finite == 0).all(axis=1)
    zeros = int(nothing.sum())
    if zeros < 2:
        return finite, dropped
    if zeros == len(finite):
        raise DataError(f"{where}: all {len(cloud)} points are {NOTHING}: nothing was measured")
    return finite[~nothing], dropped + zeros
