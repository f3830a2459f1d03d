"""Whether clouds that a net sees in metres are in metres, and above their floor.

Their domain's config says so (`unit`, `floor_m`), which for own clouds is the user's word. Files in
millimetres would train without an error, on a target of which the net then predicts one class.
"""

from __future__ import annotations

import logging

import numpy as np

from qs3.datamodules.clouds import Clouds
from qs3.errors import DataError

log = logging.getLogger(__name__)

_TIMES = 10.0  # larger: centimetres, millimetres, inches, or strays metres away from the object
_BELOW_M = 0.3  # under all of the other domain; floors are known to a decimetre or two
_LOOKED_AT = 1000  # clouds, for the floor: those are read from disk


def check_real_sizes(target: str, source: Clouds, *parts: Clouds) -> None:
    """Compare a target's clouds with the labelled ones, if the net sees sizes.

    Some that are more than ten times as large as any labelled one are named in a warning; so is a
    floor that half of the clouds reach through.

    Args:
        target: the domain's name, for messages.
        source: the labelled clouds.
        parts: the target's, such as those for training and for test.

    Raises:
        DataError: more than half of a part are so large, or more than half of the source's clouds
            are so large compared with all of the target's.
    """
    if source.scale == "unit_ball":
        return
    of_source = source.radius[source.rows]
    for part in parts:
        of_part = part.radius[part.rows]
        large = of_part > _TIMES * of_source.max()
        if np.mean(large) > 0.5 or np.mean(of_source > _TIMES * of_part.max()) > 0.5:
            raise DataError(
                f"{target}: the median radius of its clouds is {np.median(of_part):.3g}, of the "
                f"labelled ones {np.median(of_source):.3g}: one of the two is not in metres; "
                "convert it, or set data.scale=unit_ball"
            )
        if large.any():
            log.warning(
                "%s: more than ten times as large as any labelled cloud: %s",
                target,
                ", ".join(part.ids[i] for i in np.flatnonzero(large)[:3]),
            )
        if source.scale == "above_floor":
            lowest = _lowest(part)
            if np.mean(lowest < _lowest(source).min() - _BELOW_M) > 0.5:
                log.warning(
                    "%s: half of the clouds end %.2g m or more below their floor (floor_m=%g)",
                    target,
                    -np.median(lowest),
                    part.floor,
                )


def _lowest(clouds: Clouds) -> np.ndarray:
    """Height above the floor of the lowest point of each cloud, or of some, evenly spaced."""
    some = np.unique(np.linspace(0, len(clouds) - 1, min(len(clouds), _LOOKED_AT)).astype(int))
    return clouds.at(some).points[:, :, 2].min(dim=1).values.numpy()
