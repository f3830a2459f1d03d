"""Light of the place where an object is scanned, beside the sensor's own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from qs3.config.checks import check_ranges
from qs3.sensors.base import Lighting
from qs3.sensors.renderers.base import AreaLight


class Light(Protocol):
    """What a recipe's `light` is."""

    def over(self, box_m: np.ndarray) -> Lighting:
        """The light about an object with box [2, 3]."""


@dataclass(frozen=True)
class SensorLight:
    """The sensor's own light alone, and what surfaces in it give each other.

    Attributes:
        bounces: 1: surfaces light each other, once; see `Scene.bounces`. 0: they do not.
        ambient: of light from all sides, in place of `sensor.ambient`; null: that.
    """

    bounces: int = 1
    ambient: float | None = None

    def __post_init__(self) -> None:
        check_ranges(self, "light.", bounces="[0, 1]", ambient=">= 0")

    def over(self, box_m: np.ndarray) -> Lighting:
        """The same wherever the object is."""
        return Lighting(None, self.ambient, self.bounces)


@dataclass(frozen=True)
class LightAbove:
    """The paper's light (section 3.1): one area light on top of the object, a level square.

    Attributes:
        height_m: over the object's highest point.
        side_m: of the square, whose middle is over the object's.
        strength: radiance of a white level surface there, in the units of `sensor.ambient`: with
            sensor=speckle_stereo a lit dot on white has 1 at 4 m.
        ambient: of light from all sides, in place of `sensor.ambient`; null: that.
        bounces: 1: surfaces in the projector's light light each other, once.
    """

    height_m: float = 1.5
    side_m: float = 24.34
    strength: float = 0.15
    ambient: float | None = None
    bounces: int = 0

    def __post_init__(self) -> None:
        positive = dict.fromkeys(("height_m", "side_m"), "> 0")
        check_ranges(self, "light.", strength=">= 0", ambient=">= 0", bounces="[0, 1]", **positive)

    def over(self, box_m: np.ndarray) -> Lighting:
        """Over an object with box [2, 3]."""
        middle = box_m.mean(axis=0)
        pose = np.diag([1.0, -1.0, -1.0, 1.0])  # it looks down
        pose[:3, 3] = middle[0], middle[1], box_m[1, 2] + self.height_m
        # The share of what a point sees above itself that the square fills, by cosines.
        slope = self.side_m / (2 * self.height_m)
        part = slope / math.hypot(1, slope)
        seen = 4 / math.pi * part * math.atan(part)
        area = AreaLight(pose, self.side_m, self.strength / seen)
        return Lighting(area, self.ambient, self.bounces)
