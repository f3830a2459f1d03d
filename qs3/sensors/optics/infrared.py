"""From radiance to the 8-bit image that a matcher sees: exposure, shot and read noise."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np
from annotated_types import Ge, Interval

from qs3.sensors.renderers.base import Image
from qs3.utils.settings import NotNegative, Positive, Share, settings


@dataclass(frozen=True)
class GreyNoise:
    """Shot and read noise of a picture, as in `InfraredCamera`."""

    electrons_at_white: float
    read_noise_e: float

    def variance(self, mean: np.ndarray) -> np.ndarray:
        """Noise of whole grey values, at mean grey values of any shape; rounding has 1/12 of it."""
        per_grey = self.electrons_at_white / 255.0
        return np.maximum(mean, 0) / per_grey + (self.read_noise_e / per_grey) ** 2 + 1 / 12


@settings
class InfraredCamera:
    """A linear 8-bit sensor with automatic exposure.

    Exposure comes first, and an amplifier does the rest: as many grey values of fewer electrons,
    so that noise grows with it.

    Attributes:
        white_quantile: the exposure puts this quantile of the metered radiance ...
        white_level: ... at this grey value (0..255); brighter pixels saturate.
        electrons_at_white: electrons collected at grey value 255, before any amplifier; shot
            noise has a variance equal to the number of electrons.
        read_noise_e: standard deviation of the read-out noise in electrons.
        speckle_contrast: of the laser's own speckle, standard deviation over mean: radiance is
            multiplied by a Gamma variable with mean 1 and shape 1 / contrast ** 2 (Landau,
            Choo and Betts, IEEE Trans. Cybernetics 2016; they fitted shapes from 4.5 to 400).
        psf_px: standard deviation of the lens's point spread, a Gaussian; 0 is a perfect lens.
        fixed_gain: grey values per unit of radiance; null is automatic exposure. White at the
            sensor's reference distance has radiance 1.
        ambient_speckles: false: light that is not the projector's, and so no laser's, has no
            speckle; takes one more render a frame.
        metering: what the exposure goes by: "object", what bodies with a label show, or "image",
            all surfaces in the part of the view that is rendered; null: what the sensor's kind
            does, which is "object" for two cameras and "image" for one.
        max_exposure: grey values per unit of radiance at the longest exposure; null: as long as
            it takes.
        max_gain: by how much the amplifier makes up for what `max_exposure` lacks, at most.
    """

    white_quantile: Annotated[float, Interval(gt=0, le=1)] = 0.98
    white_level: Annotated[float, Interval(gt=0, le=255)] = 220.0
    electrons_at_white: Positive = 10_000.0
    read_noise_e: NotNegative = 30.0
    speckle_contrast: Share = 0.0
    psf_px: Annotated[float, Interval(ge=0, le=10)] = 0.0
    fixed_gain: Positive | None = None
    ambient_speckles: bool = True
    metering: Literal["object", "image"] | None = None
    max_exposure: Positive | None = None
    max_gain: Annotated[float, Ge(1)] = 1.0

    @property
    def needs_ambient(self) -> bool:
        """Whether `expose` asks for the ambient light alone."""
        return self.speckle_contrast > 0 and not self.ambient_speckles

    def metered(self, image: Image, usual: Literal["object", "image"]) -> np.ndarray:
        """The pixels [h, w] bool that the exposure goes by; `usual` is the sensor's kind's."""
        if (self.metering or usual) == "image":
            return np.isfinite(image.depth_m)
        return image.label > 0

    def gain(self, radiance: np.ndarray, region: np.ndarray) -> float:
        """Grey values per unit of radiance, from the pixels of `region` (bool, [h, w])."""
        if self.fixed_gain is not None:
            return self.fixed_gain
        values = radiance[region]
        white = float(np.quantile(values, self.white_quantile)) if values.size else 0.0
        wanted = self.white_level / white if white > 0 else 0.0
        if self.max_exposure is None:
            return wanted
        return min(wanted, self.max_exposure * self.max_gain)

    def amplified(self, gain: float) -> float:
        """By how much the amplifier raises what the longest exposure gives; 1: not at all."""
        return 1.0 if self.max_exposure is None else max(1.0, gain / self.max_exposure)

    def noise(self, gain: float) -> GreyNoise:
        """Noise of pictures with `gain` grey values per unit of radiance, speckle aside."""
        return GreyNoise(self.electrons_at_white / self.amplified(gain), self.read_noise_e)

    def expose(
        self,
        radiance: np.ndarray,
        gain: float,
        rng: np.random.Generator,
        ambient: np.ndarray | None = None,
    ) -> np.ndarray:
        """One exposure, [h, w] uint8, of `radiance` [h, w] float32.

        `gain` is shared by the cameras of one rig. `ambient` [h, w] is the part of the radiance
        that has no speckle; None: nothing.
        """
        per_grey = self.electrons_at_white / 255.0 / self.amplified(gain)
        if self.speckle_contrast:  # before the lens: grains are as small as its blur or smaller
            k = 1 / self.speckle_contrast**2
            grains = rng.standard_gamma(k, radiance.shape, dtype=np.float32) / np.float32(k)
            if ambient is None:
                radiance = radiance * grains
            else:
                radiance = ambient + (radiance - ambient) * grains
        if self.psf_px:
            radiance = cv2.GaussianBlur(radiance, (0, 0), self.psf_px)
        electrons = radiance * np.float32(gain * per_grey)
        # The normal law stands in for Poisson's: at the few hundred electrons of a dark
        # pixel the two differ by less than the grey step.
        sigma = np.sqrt(np.maximum(electrons, 0) + np.float32(self.read_noise_e**2))
        noisy = electrons + sigma * rng.standard_normal(radiance.shape, dtype=np.float32)
        return np.clip(np.rint(noisy / np.float32(per_grey)), 0, 255).astype(np.uint8)


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


@settings
class FilmicCamera:
    """A camera without noise whose picture is a tone-mapped 8-bit file, as released.

    Its exposure is fixed (gain 1): radiance has to come in Blender's units.

    Attributes:
        background: radiance of the surroundings behind the object (the released scene's grey
            world: 0.0509). Renderers leave it at 0.
        faintest: radiance of the object where no dot falls (albedo times ambient). A pixel with
            less is only partly covered by the object; the background shows through the rest.
    """

    background: NotNegative = 0.0
    faintest: Positive = 0.216
    needs_ambient: ClassVar[bool] = False

    def expose(
        self,
        radiance: np.ndarray,
        gain: float,
        rng: np.random.Generator,
        ambient: np.ndarray | None = None,
    ) -> np.ndarray:
        """[h, w] uint8 picture of [h, w] float32 radiance; draws nothing from `rng`."""
        light = np.asarray(radiance, dtype=np.float64) * gain
        free = np.clip(1 - light / self.faintest, 0, 1)
        return np.rint(filmic(light + self.background * free)).astype(np.uint8)
