"""What bodies are made of, and the light of the place where they are scanned."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from annotated_types import Interval

from qs3.sensors.base import Lighting
from qs3.sensors.renderers.base import AreaLight, Body
from qs3.sensors.renderers.gloss import Gloss
from qs3.utils.settings import NotNegative, Positive, Share, settings


@settings
class Principled:
    """One glossy material for all bodies; the defaults are Blender's default BSDF (`Gloss`)."""

    albedo: Share = 0.8
    roughness: Annotated[float, Interval(ge=0.1, le=1)] = 0.5
    specular: Share = 0.5

    def dress(self, bodies: Sequence[Body]) -> tuple[Body, ...]:
        """The same shapes of this material."""
        gloss = Gloss(self.roughness, self.specular)
        return tuple(replace(body, albedo=self.albedo, gloss=gloss) for body in bodies)


@settings
class LightAbove:
    """The paper's light (section 3.1): one area light on top of the object, a level square.

    Its strength is the radiance of a white level surface there, in the units of `sensor.ambient`:
    with sensor=speckle_stereo a lit dot on white has 1 at 4 m.
    """

    height_m: Positive = 1.5  # over the object's highest point
    side_m: Positive = 24.34  # of the square, whose middle is over the object's
    strength: NotNegative = 0.15
    ambient: NotNegative | None = None  # of light from all sides; null: `sensor.ambient`

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
        return Lighting(area, self.ambient)
