"""Why a pixel of a depth image has a value, or has none."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum

import numpy as np


class Reason(IntEnum):
    """One for each pixel; what comes first in this list wins where several hold.

    OK: it has a depth.
    EMPTY: no surface there, or none in reach.
    SHADOW: the projector does not reach the surface.
    OCCLUDED: the other camera does not see the surface.
    OUTSIDE: the other image, or the pattern, ends before it.
    DARK: too little light or contrast.
    SATURATED: too much light.
    AMBIGUOUS: several places match as well.
    INCONSISTENT: matching the other way round gives another place.
    RANGE: a depth was found, outside the range of the sensor.
    FILTERED: a depth was found and a filter removed it.
    UNMATCHED: none of these, or the matcher does not tell.
    """

    OK = 0
    EMPTY = 1
    SHADOW = 2
    OCCLUDED = 3
    OUTSIDE = 4
    DARK = 5
    SATURATED = 6
    AMBIGUOUS = 7
    INCONSISTENT = 8
    RANGE = 9
    FILTERED = 10
    UNMATCHED = 11


def first_reason(causes: Mapping[Reason, np.ndarray], otherwise: Reason) -> np.ndarray:
    """[h, w] uint8: of each pixel the first reason whose mask [h, w] holds, else `otherwise`."""
    reasons = [np.uint8(reason) for reason in causes]
    return np.select(list(causes.values()), reasons, np.uint8(otherwise)).astype(np.uint8)
