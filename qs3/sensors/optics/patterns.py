"""Speckle patterns: the slides that projectors throw.

Real devices use fixed pseudo-random dots. The slide packed into the released scene is the
Kinect v1 pattern (3 x 3 tiles of 211 x 165 dots positions, about 11 % lit) enlarged twice;
ours have the same statistics and are drawn from a seed, so that nothing vendor-made is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np

from qs3.config.checks import check_ranges
from qs3.errors import ConfigError


class Slide(Protocol):
    """What a projector throws."""

    @property
    def slide(self) -> np.ndarray:
        """[H, W] float32 in 0..1, row 0 at the top."""


@dataclass(frozen=True)
class Speckle:
    """A pseudo-random pattern of square dots that keep a distance from each other.

    Attributes:
        columns, rows: dot positions of one tile.
        tiles: how often the tile is repeated along each side; a tile must be wider than
            the search range of a matcher, or matches are ambiguous.
        dot_px: side of a position in slide pixels (the released slide: 2).
        fill: share of lit positions (the released slide: 0.111).
        spacing: lit positions keep at least this distance (in positions, Chebyshev).
        seed: of the pattern; a device has one pattern, so it belongs to the sensor.
        brightness_spread: lit dots have a brightness uniform in 1 - spread .. 1, as those of a
            diffractive element have (Reichinger 2011, of Kinect v1).
    """

    columns: int = 633
    rows: int = 495
    tiles: int = 1
    dot_px: int = 2
    fill: float = 0.111
    spacing: int = 1
    seed: int = 0
    brightness_spread: float = 0.0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "pattern.",
            brightness_spread="[0, 1]",
            spacing=">= 0",
            **dict.fromkeys(("columns", "rows", "tiles", "dot_px"), ">= 1"),
        )
        densest = 1 / (1 + self.spacing) ** 2
        if not 0 < self.fill <= 0.6 * densest:
            raise ConfigError(
                f"pattern.fill {self.fill} cannot be reached with spacing {self.spacing}: "
                f"it must be in (0, {0.6 * densest:.3f}]"
            )
        places = self.rows * self.columns
        if not self._wanted:
            raise ConfigError(
                f"pattern.fill {self.fill} lights none of the {places} positions of a tile: it "
                f"must be above {0.5 / places:.2g}, or take more pattern.columns and rows"
            )
        if (self._wanted - 1) * (2 * self.spacing + 1) ** 2 >= places:
            self._dots(self._rng())  # with fewer there is always room for one more

    @property
    def _wanted(self) -> int:
        """Lit positions of a tile."""
        return round(self.fill * self.rows * self.columns)

    def _rng(self) -> np.random.Generator:
        return np.random.default_rng([0x5BEC, self.seed])

    def _dots(self, rng: np.random.Generator) -> np.ndarray:
        """[rows, columns] bool of a tile; ConfigError if so many dots find no room."""
        tile = _spaced_dots(self.rows, self.columns, self._wanted, self.spacing, rng)
        if (placed := int(tile.sum())) < self._wanted:
            raise ConfigError(
                f"pattern.fill {self.fill} cannot be reached with spacing {self.spacing}: of "
                f"{self._wanted} dots of a tile {placed} found room, so that it must be at most "
                f"{placed / tile.size:.3g}"
            )
        return tile

    @cached_property
    def slide(self) -> np.ndarray:
        """[rows * tiles * dot_px, columns * tiles * dot_px] float32, 0 dark or 1 lit."""
        rng = self._rng()
        tile = self._dots(rng)
        if self.brightness_spread:
            tile = tile * (1 - self.brightness_spread * rng.random(tile.shape))
        image = np.tile(tile, (self.tiles, self.tiles))
        image = image.repeat(self.dot_px, axis=0).repeat(self.dot_px, axis=1)
        image = np.ascontiguousarray(image, dtype=np.float32)
        image.flags.writeable = False
        return image


def _spaced_dots(
    rows: int, columns: int, wanted: int, spacing: int, rng: np.random.Generator
) -> np.ndarray:
    """Random sequential placement on a torus, so that tiles join without a seam.

    Where no room is left for a dot it ends with fewer than the `wanted`, which are at least 1.
    """
    lit = np.zeros(rows * columns, dtype=bool)
    blocked = bytearray(rows * columns)  # single elements of arrays are slow
    placed = 0
    offsets = range(-spacing, spacing + 1)
    near = [[(column + i) % columns for i in offsets] for column in range(columns)]
    for position in rng.permutation(rows * columns).tolist():
        if blocked[position]:
            continue
        lit[position] = True
        row, column = divmod(position, columns)
        for i in offsets:
            start = (row + i) % rows * columns
            for other in near[column]:
                blocked[start + other] = 1
        placed += 1
        if placed == wanted:
            break
    return lit.reshape(rows, columns)


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
