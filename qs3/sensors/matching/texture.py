"""How much texture a match needs: more than the camera's own noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from qs3.config.checks import check_ranges


@dataclass(frozen=True)
class TextureOverNoise:
    """A window is textured if it varies more than the camera's noise lets a flat one vary.

    In contrast to a threshold in grey values it asks no more of a dim or a dull picture than of a
    bright one. The noise is the camera's shot and read noise at the window's mean grey value.

    Attributes:
        ratio: standard deviation of the texture over that of the noise. In 9 x 9 pixels of noise
            alone the two are mistaken for each other up to a ratio of about 0.6.
        electrons_at_white: electrons at grey value 255.
        read_noise_e: read-out noise, electrons.
    """

    ratio: float = 0.7
    electrons_at_white: float = 10_000.0
    read_noise_e: float = 30.0

    def __post_init__(self) -> None:
        check_ranges(self, "texture.", ratio="> 0", electrons_at_white="> 0", read_noise_e=">= 0")

    def enough(self, mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """[h, w] bool from the mean and the variance of the grey values of each window."""
        per_grey = self.electrons_at_white / 255.0
        # 1/12: rounding to whole grey values.
        noise = np.maximum(mean, 0) / per_grey + (self.read_noise_e / per_grey) ** 2 + 1 / 12
        return variance >= (1 + self.ratio**2) * noise


def window_moments(image: np.ndarray, window_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance [h, w] float32 of the grey values in the window around each pixel."""
    grey = image.astype(np.float32)
    size, border = (window_px, window_px), cv2.BORDER_REFLECT_101
    mean = cv2.boxFilter(grey, cv2.CV_32F, size, borderType=border)
    square = cv2.boxFilter(grey * grey, cv2.CV_32F, size, borderType=border)
    return mean, np.maximum(square - mean * mean, 0)
