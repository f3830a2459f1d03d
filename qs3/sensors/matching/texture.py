"""How much texture a match needs: more than the camera's own noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from qs3.config.checks import check_ranges
from qs3.errors import ConfigError
from qs3.sensors.matching.base import Matcher
from qs3.sensors.optics.infrared import GreyNoise


@dataclass(frozen=True)
class TextureOverNoise:
    """A window is textured if it varies more than the camera's noise lets a flat one vary.

    In contrast to a threshold in grey values it asks no more of a dim or a dull picture than of a
    bright one. The noise is the camera's shot and read noise at the window's mean grey value, and
    of what its amplifier does to the picture; sensors say both for each picture (`for_picture`).

    Attributes:
        ratio: standard deviation of the texture over that of the noise. In 9 x 9 pixels of noise
            alone the two are mistaken for each other up to a ratio of about 0.6.
        electrons_at_white: electrons at grey value 255; null: as the picture's camera has them.
        read_noise_e: read-out noise, electrons; null: the camera's.
    """

    ratio: float = 0.7
    electrons_at_white: float | None = None
    read_noise_e: float | None = None

    def __post_init__(self) -> None:
        check_ranges(self, "texture.", ratio="> 0", electrons_at_white="> 0", read_noise_e=">= 0")

    def enough(self, mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """[h, w] bool from the mean and the variance of the grey values of each window.

        Raises:
            ConfigError: nobody has said what the noise is.
        """
        if self.electrons_at_white is None or self.read_noise_e is None:
            raise ConfigError(
                "matcher.texture goes by the camera's noise, and this camera has none: set "
                "texture.electrons_at_white and texture.read_noise_e, or texture=null"
            )
        noise = GreyNoise(self.electrons_at_white, self.read_noise_e).variance(mean)
        return variance >= (1 + self.ratio**2) * noise

    def at(self, noise: GreyNoise) -> TextureOverNoise:
        """With `noise` where nothing was set."""
        electrons, read = self.electrons_at_white, self.read_noise_e
        return replace(
            self,
            electrons_at_white=noise.electrons_at_white if electrons is None else electrons,
            read_noise_e=noise.read_noise_e if read is None else read,
        )


def for_picture(matcher: Matcher, noise: GreyNoise) -> Matcher:
    """The matcher for pictures with this noise; itself, if it has no `texture` that asks."""
    texture = getattr(matcher, "texture", None)
    if not isinstance(texture, TextureOverNoise) or texture.at(noise) == texture:
        return matcher
    return replace(matcher, texture=texture.at(noise))  # type: ignore[type-var]


def window_moments(image: np.ndarray, window_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance [h, w] float32 of the grey values in the window around each pixel."""
    grey = image.astype(np.float32)
    size, border = (window_px, window_px), cv2.BORDER_REFLECT_101
    mean = cv2.boxFilter(grey, cv2.CV_32F, size, borderType=border)
    square = cv2.boxFilter(grey * grey, cv2.CV_32F, size, borderType=border)
    return mean, np.maximum(square - mean * mean, 0)
