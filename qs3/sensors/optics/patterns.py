"""Speckle patterns: the slides that projectors throw.

Real devices use fixed pseudo-random dots. The slide packed into the released scene is the
Kinect v1 pattern (3 x 3 tiles of 211 x 165 dots positions, about 11 % lit) enlarged twice;
ours have the same statistics and are drawn from a seed, so that nothing vendor-made is needed.
"""

from functools import cached_property, lru_cache
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge, Interval

from qs3.utils.settings import Count, settings


@settings
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

    columns: Count = 633
    rows: Count = 495
    tiles: Count = 1
    dot_px: Count = 2
    fill: Annotated[float, Interval(gt=0, le=0.6)] = 0.111
    spacing: Annotated[int, Ge(0)] = 1
    seed: int = 0

    @cached_property
    def slide(self) -> np.ndarray:
        """[rows * tiles * dot_px, columns * tiles * dot_px] float32, 0 dark or 1 lit."""
        wanted = round(self.fill * self.rows * self.columns)
        tile = _spaced_dots(self.rows, self.columns, wanted, self.spacing, self.seed)
        assert 0 < tile.sum() == wanted, f"pattern.fill={self.fill}: {tile.sum()} dots of {wanted}"
        image = np.tile(tile, (self.tiles, self.tiles))
        return _frozen(image.repeat(self.dot_px, axis=0).repeat(self.dot_px, axis=1))


def _frozen(image: np.ndarray) -> np.ndarray:
    image = np.ascontiguousarray(image, dtype=np.float32)
    image.flags.writeable = False
    return image


@lru_cache(maxsize=8)  # sensors that are built again have the same few patterns
def _spaced_dots(rows: int, columns: int, wanted: int, spacing: int, seed: int) -> np.ndarray:
    """Random sequential placement on a torus, so that tiles join without a seam.

    Where no room is left for a dot it ends with fewer than the `wanted`, which are at least 1.
    """
    lit = np.zeros(rows * columns, dtype=bool)
    blocked = bytearray(rows * columns)  # single elements of arrays are slow
    placed = 0
    offsets = range(-spacing, spacing + 1)
    near = [[(column + i) % columns for i in offsets] for column in range(columns)]
    rng = np.random.default_rng([0x5BEC, seed])
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


@settings
class ReleasedSlide(Speckle):
    """A speckle pattern with the shape of the released slide's dots.

    The released scene projects its 1266 x 990 px picture onto a square, so that its dots are higher
    than wide (3.0 x 3.8 px of the camera). And the picture is 8-bit sRGB, which Cycles
    interpolates as stored and decodes afterwards: a dot is smaller and its slopes are steeper, so
    that the matcher locks more to whole pixels.

    Attributes:
        detail: pixels of the slide for each of the picture, after interpolation.
    """

    columns: Count = 211
    rows: Count = 165
    tiles: Count = 3
    detail: Count = 2

    @cached_property
    def slide(self) -> np.ndarray:
        """[n, n] float32 in 0..1, linear; n is the picture's width times `detail`."""
        stored = Speckle(
            self.columns, self.rows, self.tiles, self.dot_px, self.fill, self.spacing, self.seed
        ).slide
        side = stored.shape[1] * self.detail
        smooth = cv2.resize(stored, (side, side), interpolation=cv2.INTER_LINEAR)
        steep = ((smooth + 0.055) / 1.055) ** 2.4
        return _frozen(np.where(smooth <= 0.04045, smooth / 12.92, steep))
