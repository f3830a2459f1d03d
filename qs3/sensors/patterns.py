"""Speckle patterns: the slides that projectors throw.

Real devices use fixed pseudo-random dots. The slide packed into the released scene is the
Kinect v1 pattern (3 x 3 tiles of 211 x 165 dots positions, about 11 % lit) enlarged twice;
ours have the same statistics and are drawn from a seed, so that nothing vendor-made is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from qs3.errors import ConfigError


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
    """

    columns: int = 633
    rows: int = 495
    tiles: int = 1
    dot_px: int = 2
    fill: float = 0.111
    spacing: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.columns, self.rows, self.tiles, self.dot_px) < 1:
            raise ConfigError("a speckle pattern needs columns, rows, tiles and dot_px >= 1")
        densest = 1 / (1 + self.spacing) ** 2
        if not 0 < self.fill <= 0.6 * densest:
            raise ConfigError(
                f"pattern.fill {self.fill} cannot be reached with spacing {self.spacing}: "
                f"it must be in (0, {0.6 * densest:.3f}]"
            )

    @cached_property
    def slide(self) -> np.ndarray:
        """[rows * tiles * dot_px, columns * tiles * dot_px] float32, 0 dark or 1 lit."""
        rng = np.random.default_rng([0x5BEC, self.seed])
        tile = _spaced_dots(self.rows, self.columns, self.fill, self.spacing, rng)
        image = np.tile(tile, (self.tiles, self.tiles))
        image = image.repeat(self.dot_px, axis=0).repeat(self.dot_px, axis=1)
        image = np.ascontiguousarray(image, dtype=np.float32)
        image.flags.writeable = False
        return image


def _spaced_dots(
    rows: int, columns: int, fill: float, spacing: int, rng: np.random.Generator
) -> np.ndarray:
    """Random sequential placement on a torus, so that tiles join without a seam."""
    lit = np.zeros((rows, columns), dtype=bool)
    blocked = np.zeros((rows, columns), dtype=bool)
    wanted = round(fill * rows * columns)
    placed = 0
    offsets = np.arange(-spacing, spacing + 1)
    for position in rng.permutation(rows * columns):
        row, column = divmod(int(position), columns)
        if blocked[row, column]:
            continue
        lit[row, column] = True
        blocked[np.ix_((row + offsets) % rows, (column + offsets) % columns)] = True
        placed += 1
        if placed == wanted:
            break
    return lit
