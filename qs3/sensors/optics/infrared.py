"""From radiance to the 8-bit image that a matcher sees: exposure, shot and read noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from qs3.config.checks import check_bool, check_ranges


@dataclass(frozen=True)
class InfraredCamera:
    """A linear 8-bit sensor with automatic exposure.

    Noise is drawn here and not left to Monte Carlo luck of the renderer, so that it is the
    same whatever the number of samples a pixel.

    Attributes:
        white_quantile: the exposure puts this quantile of the object's radiance ...
        white_level: ... at this grey value (0..255); brighter pixels saturate.
        electrons_at_white: electrons collected at grey value 255; shot noise has a variance
            equal to the number of electrons.
        read_noise_e: standard deviation of the read-out noise in electrons.
        speckle_contrast: of the laser's own speckle, standard deviation over mean: radiance is
            multiplied by a Gamma variable with mean 1 and shape 1 / contrast ** 2 (Landau,
            Choo and Betts, IEEE Trans. Cybernetics 2016; they fitted shapes from 4.5 to 400).
        psf_px: standard deviation of the lens's point spread, a Gaussian; 0 is a perfect lens.
        fixed_gain: grey values per unit of radiance; null is automatic exposure. White at the
            sensor's reference distance has radiance 1.
        speckle_grain_px: side of the square grains that share a value; 1 is a pixel.
        ambient_speckles: false: light that is not the projector's, and so no laser's, has no
            speckle; takes one more render a frame.
    """

    white_quantile: float = 0.98
    white_level: float = 220.0
    electrons_at_white: float = 10_000.0
    read_noise_e: float = 30.0
    speckle_contrast: float = 0.0
    psf_px: float = 0.0
    fixed_gain: float | None = None
    speckle_grain_px: int = 1
    ambient_speckles: bool = True

    def __post_init__(self) -> None:
        check_ranges(
            self,
            white_quantile="(0, 1]",
            white_level="(0, 255]",
            electrons_at_white="> 0",
            read_noise_e=">= 0",
            speckle_contrast="[0, 1]",
            speckle_grain_px=">= 1",
            psf_px="[0, 10]",
            fixed_gain="> 0",
        )
        check_bool("ambient_speckles", self.ambient_speckles)

    @property
    def needs_ambient(self) -> bool:
        """Whether `expose` asks for the ambient light alone."""
        return self.speckle_contrast > 0 and not self.ambient_speckles

    def gain(self, radiance: np.ndarray, region: np.ndarray) -> float:
        """Grey values per unit of radiance, from the pixels of `region` (bool, [h, w])."""
        if self.fixed_gain is not None:
            return self.fixed_gain
        values = radiance[region]
        white = float(np.quantile(values, self.white_quantile)) if values.size else 0.0
        return self.white_level / white if white > 0 else 0.0

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
        per_grey = self.electrons_at_white / 255.0
        if self.speckle_contrast:  # before the lens: grains are as small as its blur or smaller
            grains = self._grains(radiance.shape, rng)
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

    def _grains(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """[h, w] float32 Gamma variables with mean 1."""
        (height, width), side = shape, self.speckle_grain_px
        k = 1 / self.speckle_contrast**2
        few = rng.standard_gamma(k, (-(-height // side), -(-width // side)), dtype=np.float32)
        return (few / np.float32(k)).repeat(side, axis=0).repeat(side, axis=1)[:height, :width]
