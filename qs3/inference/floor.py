"""Where the floor is in objects that one camera cut out of rooms, by the objects themselves.

An archive of cut objects is in metres, z up, the camera at its origin; how high the camera was held
it does not say. But most of what people furnish stands on the floor, and nothing ends below it: the
lowest points of many objects have a lower edge, and that is the floor. It is believed only where

- there are at least `FEWEST` objects;
- at least `ON_IT` of them end within `ABOUT_M` of it, and next to none, `BELOW_IT`, further down;
- it lies `CAMERA_M` below the camera, as in the scans that `dgcnn-rooms` learnt from. This is what
  tells a floor from the desk that all objects stand on.

No label takes part, nor the class that a net names.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from qs3.config.checks import check_float
from qs3.errors import ConfigError
from qs3.utils.plural import counted

FEWEST = 30
ABOUT_M = 0.25
ON_IT, BELOW_IT = 0.25, 0.01
CAMERA_M = (1.0, 1.8)
"""Cameras of `conf/synthesis/roomscan10.yaml` are 1.1 to 1.7 m above the floor."""

_END = 1.0
_EDGE = 10.0
"""Percentiles: of a cloud's points, where it ends; of these ends, the floor."""


_HIGHEST_M = 30.0  # of a camera over a floor: centimetres and millimetres lie above it


def check_camera_height(metres: float) -> float:
    """The height of a camera above the floor; else ConfigError, with what may be meant."""
    check_float("camera_height", metres)
    if 0 < metres < _HIGHEST_M:
        return metres
    said = f"camera_height={metres:g} is not a height above the floor in metres"
    if metres == 0:
        raise ConfigError(f"{said}: if it is not known, leave it out")
    if metres < 0:
        raise ConfigError(f"{said}: it is measured from the floor up; {-metres:g}?")
    raise ConfigError(f"{said}: {_other_unit(metres)}")


def check_floor(z: float) -> float:
    """Where a floor is in clouds, in metres along up; else ConfigError, with what may be meant."""
    check_float("floor", z)
    if abs(z) < _HIGHEST_M:
        return z
    raise ConfigError(
        f"floor={z:g} is not where a floor is in metres: {_other_unit(z)}; of clouds in a map's "
        "coordinates take the floor's height off first"
    )


def _other_unit(length: float) -> str:
    small = abs(length) < 10 * _HIGHEST_M
    per_metre, unit = (100, "centimetres") if small else (1000, "millimetres")
    return f"if these are {unit}, give {length / per_metre:g}"


def floor_is_missing() -> ConfigError:
    """For a net that knows heights, of clouds of which nobody said where their floor is."""
    return ConfigError(
        f"{_HEIGHTS}, and nothing in these clouds tells where it is: give floor=Z, 0 if objects "
        "stand on z = 0, minus the camera's height if the camera is the origin"
    )


def camera_is_missing(key: str = "camera_height=METRES", why: str = "") -> ConfigError:
    """Likewise, of what a camera saw whose height nobody said; `key` would say it."""
    return ConfigError(
        f"{_HEIGHTS}, and its target's clouds say nothing about a camera: give its height, "
        f"{key}{why}"
    )


_HEIGHTS = "the classifier knows heights above the floor"


class Floor(NamedTuple):
    """What the objects say.

    Attributes:
        z: of the floor, in metres, in the objects' coordinates; None if it cannot be told.
        words: how it is known, or why it is not.
    """

    z: float | None
    words: str


def floor_under(clouds: Iterable[Float[np.ndarray, "n 3"]]) -> Floor:
    """The floor that objects stand on, in metres, z up, the camera at the origin.

    Args:
        clouds: of objects in several rooms, n >= 1 points each.
    """
    ends = np.array([np.percentile(cloud[:, 2], _END) for cloud in clouds])
    if len(ends) < FEWEST:
        few = counted(len(ends), "object is", "objects are")
        return Floor(None, f"{few} too few to tell where the floor is")
    z = round(float(np.percentile(ends, _EDGE)), 2)
    near = float((abs(ends - z) <= ABOUT_M).mean())
    below = float((ends < z - ABOUT_M).mean())
    if near < ON_IT or below > BELOW_IT:
        return Floor(None, "the lowest points of the objects have no common lower edge")
    low, high = CAMERA_M
    if not low <= -z <= high:
        return Floor(
            None,
            f"the lowest of {len(ends)} objects end at z = {z:g}, and a camera {-z:g} m above the "
            f"floor is not what the classifier learnt from ({low:g} to {high:g} m): it may be a "
            "table",
        )
    return Floor(
        z,
        f"the floor is taken to lie at z = {z:g}, by the lowest points of {len(ends)} objects "
        f"({near:.0%} end within {100 * ABOUT_M:.0f} cm of it, {below:.1%} further down); floor= "
        "says otherwise",
    )
