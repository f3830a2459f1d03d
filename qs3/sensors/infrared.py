"""From radiance to the 8-bit image that a matcher sees: exposure, shot and read noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qs3.errors import ConfigError


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
    """

    white_quantile: float = 0.98
    white_level: float = 220.0
    electrons_at_white: float = 10_000.0
    read_noise_e: float = 30.0

    def __post_init__(self) -> None:
        if not 0 < self.white_quantile <= 1:
            raise ConfigError(f"white_quantile must be in (0, 1], got {self.white_quantile}")
        if not 0 < self.white_level <= 255:
            raise ConfigError(f"white_level must be in (0, 255], got {self.white_level}")
        if not self.electrons_at_white > 0 or self.read_noise_e < 0:
            raise ConfigError("electrons_at_white must be positive and read_noise_e >= 0")

    def gain(self, radiance: np.ndarray, region: np.ndarray) -> float:
        """Grey values per unit of radiance, from the pixels of `region` (bool, [h, w])."""
        values = radiance[region]
        white = float(np.quantile(values, self.white_quantile)) if values.size else 0.0
        return self.white_level / white if white > 0 else 0.0

    def expose(self, radiance: np.ndarray, gain: float, rng: np.random.Generator) -> np.ndarray:
        """One exposure.

        Args:
            radiance: [h, w] float32.
            gain: from `gain`, shared by the cameras of one rig.
            rng: of this exposure.

        Returns:
            [h, w] uint8.
        """
        per_grey = self.electrons_at_white / 255.0
        electrons = radiance * np.float32(gain * per_grey)
        # The normal law stands in for Poisson's: at the few hundred electrons of a dark
        # pixel the two differ by less than the grey step.
        sigma = np.sqrt(np.maximum(electrons, 0) + np.float32(self.read_noise_e**2))
        noisy = electrons + sigma * rng.standard_normal(radiance.shape, dtype=np.float32)
        return np.clip(np.rint(noisy / np.float32(per_grey)), 0, 255).astype(np.uint8)
