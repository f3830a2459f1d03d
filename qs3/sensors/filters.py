"""What devices do to a disparity map after matching: quantise it, and drop what looks wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from qs3.errors import ConfigError


@dataclass(frozen=True)
class Quantiser:
    """The device's step of disparity.

    Attributes:
        steps_per_px: 8 is 1/8 px (Kinect v1), 32 is 1/32 px (RealSense D400); 0 is none.
    """

    steps_per_px: int = 0

    def __post_init__(self) -> None:
        if self.steps_per_px < 0:
            raise ConfigError(f"steps_per_px must be >= 0, got {self.steps_per_px}")

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """[h, w] float32, rounded to the nearest step; NaN stays."""
        if not self.steps_per_px:
            return disparity
        return (np.rint(disparity * self.steps_per_px) / self.steps_per_px).astype(np.float32)


class PostFilter(Protocol):
    """Changes or drops disparities."""

    def apply(self, disparity: np.ndarray) -> np.ndarray:
        """[h, w] float32 px with NaN -> the same, changed; dropped values are NaN."""
        ...
