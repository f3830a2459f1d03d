"""A lamp without a pattern, and a picture of what it lights."""

from __future__ import annotations

import numpy as np

from qs3.sensors.renderers.base import Projector

_WHITE = np.ones((2, 2), dtype=np.float32)
_WIDE = 10.0  # tangent of half the lamp's angle: all that lies before it


def white_lamp(world_from_lamp: np.ndarray, strength: float = 1.0) -> Projector:
    """A point lamp that lights all that lies before it, as a projector with a white slide.

    Args:
        world_from_lamp: [4, 4]; it looks along its +z.
        strength: radiance of white at 1 m, see `Projector`.
    """
    return Projector(world_from_lamp, _WHITE, _WIDE, strength)


def grey_picture(image: np.ndarray) -> np.ndarray:
    """[h, w] of any scale -> uint8 for looking at: the 98 % quantile of what is lit at 220."""
    lit = image[image > 0]
    white = float(np.quantile(lit, 0.98)) if lit.size else 1.0
    return np.clip(np.rint(image * (220 / white)), 0, 255).astype(np.uint8)
