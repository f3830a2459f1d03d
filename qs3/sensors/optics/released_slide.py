"""A slide as the released scene throws it: stretched, and interpolated before it is decoded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from qs3.config.checks import check_ranges
from qs3.errors import ConfigError
from qs3.sensors.optics.patterns import Speckle


@dataclass(frozen=True)
class ReleasedSlide(Speckle):
    """A speckle pattern with the shape of the released slide's dots.

    The released scene projects its 1266 x 990 px picture onto a square, so that its dots are higher
    than wide (3.0 x 3.8 px of the camera). And the picture is 8-bit sRGB, which Cycles
    interpolates as stored and decodes afterwards: a dot's slopes are steeper than a linear
    slide's, and it is smaller. The matcher locks more to whole pixels on such dots: on a plane at
    4 m its error grows from 0.057 to 0.088 px (released scene: 0.083 px).

    Attributes:
        detail: pixels of the slide for each of the picture, after interpolation.
        brightness_spread: 0, for the picture's dots are all white.
    """

    columns: int = 211
    rows: int = 165
    tiles: int = 3
    detail: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, "pattern.", detail=">= 1")
        if self.brightness_spread:
            raise ConfigError(
                "the released slide's dots are equally bright: leave pattern.brightness_spread at "
                f"0, got {self.brightness_spread}, or take optics.patterns.Speckle as the pattern"
            )

    @cached_property
    def slide(self) -> np.ndarray:
        """[n, n] float32 in 0..1, linear; n is the picture's width times `detail`."""
        stored = Speckle(
            self.columns, self.rows, self.tiles, self.dot_px, self.fill, self.spacing, self.seed
        ).slide
        side = stored.shape[1] * self.detail
        smooth = cv2.resize(stored, (side, side), interpolation=cv2.INTER_LINEAR)
        image = np.where(smooth <= 0.04045, smooth / 12.92, ((smooth + 0.055) / 1.055) ** 2.4)
        image = np.ascontiguousarray(image, dtype=np.float32)
        image.flags.writeable = False
        return image
