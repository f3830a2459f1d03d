"""Blender's Filmic tone curve to 8 bits: what the released code made of its renders.

A linear sensor (qs3.sensors.optics.infrared) keeps the ratio of two radiances; Filmic bends it, so
bright dots are compressed. There is no noise and no automatic exposure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qs3.config.checks import check_ranges
from qs3.sensors.renderers.base import Image

# Logarithms to base 2 of the radiance where the curve begins and where it ends.
_FIRST_STOP, _LAST_STOP = -12.473931188, 4.026068812
# Grey values (0..255) at evenly spaced stops, measured from bpy 4.5.15: a float image saved as a
# 16-bit PNG with view transform Filmic, look None, exposure 0, gamma 1, display sRGB.
# fmt: off
_CURVE = np.array([
    0.00, 0.16, 0.32, 0.50, 0.70, 0.91, 1.14, 1.39, 1.67, 1.96,
    2.28, 2.63, 3.01, 3.42, 3.86, 4.34, 4.86, 5.43, 6.04, 6.70,
    7.42, 8.19, 9.03, 9.93, 10.91, 11.96, 13.10, 14.33, 15.65, 17.07,
    18.60, 20.25, 22.02, 23.91, 25.95, 28.12, 30.45, 32.93, 35.58, 38.40,
    41.40, 44.58, 47.95, 51.51, 55.26, 59.21, 63.36, 67.71, 72.25, 76.98,
    81.89, 86.98, 92.24, 97.65, 103.20, 108.88, 114.66, 120.53, 126.47, 132.39,
    138.31, 144.24, 150.14, 156.00, 161.78, 167.48, 173.07, 178.52, 183.83, 188.98,
    193.95, 198.72, 203.30, 207.67, 211.83, 215.78, 219.50, 223.00, 226.29, 229.37,
    232.23, 234.88, 237.34, 239.60, 241.68, 243.57, 245.30, 246.87, 248.28, 249.54,
    250.67, 251.67, 252.55, 253.32, 253.97, 254.53, 255.00,
])
# fmt: on


def filmic(radiance: np.ndarray) -> np.ndarray:
    """Scene-linear radiance, any shape, to grey values as Blender's Filmic transform does.

    Returns:
        The same shape, float64 in 0..255, not rounded, within 0.1 of Blender's; 16.3 is white.
    """
    stops = np.log2(np.maximum(radiance, 2.0**_FIRST_STOP))
    place = (stops - _FIRST_STOP) / (_LAST_STOP - _FIRST_STOP) * (len(_CURVE) - 1)
    return np.interp(place, np.arange(len(_CURVE)), _CURVE)


@dataclass(frozen=True)
class FilmicCamera:
    """A camera without noise whose picture is a tone-mapped 8-bit file, as released.

    It stands where an `InfraredCamera` stands. Its exposure is fixed: radiance has to come in
    Blender's units (see `SpeckleStereo.projector_strength`).

    Attributes:
        background: radiance of the surroundings behind the object (the released scene's grey
            world: 0.0509). Renderers leave it at 0.
        faintest: radiance of the object where no dot falls (albedo times ambient). A pixel with
            less is only partly covered by the object; the background shows through the rest.
    """

    background: float = 0.0
    faintest: float = 0.216

    def __post_init__(self) -> None:
        check_ranges(self, "infrared.", background=">= 0", faintest="> 0")

    def metered(self, image: Image, usual: str) -> np.ndarray:
        """The pixels [h, w] bool of the object; nothing depends on them."""
        return image.label > 0

    def gain(self, radiance: np.ndarray, region: np.ndarray) -> float:
        """1: exposure 0, whatever is seen."""
        return 1.0

    def expose(self, radiance: np.ndarray, gain: float, rng: np.random.Generator) -> np.ndarray:
        """[h, w] uint8 picture of [h, w] float32 radiance; draws nothing from `rng`."""
        light = np.asarray(radiance, dtype=np.float64) * gain
        free = np.clip(1 - light / self.faintest, 0, 1)
        return np.rint(filmic(light + self.background * free)).astype(np.uint8)
