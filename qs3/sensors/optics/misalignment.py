"""What a factory's calibration leaves: rows and columns that do not meet."""

import math
from functools import lru_cache
from typing import Annotated

import numpy as np
import scipy  # imports its parts when they are used
from annotated_types import Interval

from qs3.geometry.cameras import Window
from qs3.utils.settings import Positive, settings

_WAVES = 64


def smooth_field(window: Window, cell_px: float, rng: np.random.Generator) -> np.ndarray:
    """A stationary field [h, w] of mean 0, variance 1 and no waves shorter than `cell_px`.

    The sum of plane waves with random directions, lengths and phases: a fixed number of draws.
    What a pixel gets does not depend on the window.
    """
    direction, offset = rng.uniform(0, 2 * np.pi, (2, _WAVES))
    # Uniform over the disc of frequencies up to 1 / cell.
    frequency = 2 * np.pi / cell_px * np.sqrt(rng.uniform(0, 1, _WAVES))
    u = np.outer(window.left + np.arange(window.width), frequency * np.cos(direction)) + offset
    v = np.outer(window.top + np.arange(window.height), frequency * np.sin(direction))
    # cos(a + b) by the addition theorem. Not as a matrix product: a library for those may
    # round differently with another number of threads.
    field = np.einsum("hk,wk->hw", np.cos(v), np.cos(u), optimize=False)
    field -= np.einsum("hk,wk->hw", np.sin(v), np.sin(u), optimize=False)
    return field * np.sqrt(2 / _WAVES)


_Shift = Annotated[float, Interval(ge=0, le=10)]


@settings
class Misalignment:
    """Errors that stay in a pair of rectified images, the same in each frame of a device.

    The right image is shifted by two smooth fields, one along the rows and one along the columns,
    as by a lens that the calibration's polynomial does not follow. Shifts across the rows cost
    matches; those along them are a bias of the disparity, and so of the depth.

    Attributes:
        rows_px: RMS shift across the rows (vertical), in px.
        columns_px: RMS shift along the rows (horizontal), in px.
        cell_px: shortest wave of the fields, in px.
        seed: of the fields: the device.
    """

    rows_px: _Shift = 0.0
    columns_px: _Shift = 0.0
    cell_px: Positive = 300.0
    seed: int = 0

    @property
    def reach_px(self) -> int:
        """By how much a pixel is shifted at most: four times the fields' RMS."""
        return math.ceil(4 * max(self.rows_px, self.columns_px))

    def seen(self, image: np.ndarray, canvas: Window) -> np.ndarray:
        """The picture [h, w] float32 of the right camera in place of the ideal `image`.

        `canvas` is where its pixels lie in the whole image.
        """
        if not self.reach_px:
            return image
        from qs3.sensors.optics.numba_kernels import spline_at

        # Not OpenCV's cubic: it rounds places to 1/32 px, and is up to 0.05 px off on a ramp.
        # Its coefficients fade within 12 px of the border.
        spline = scipy.ndimage.spline_filter(np.pad(image, 12), mode="grid-constant")
        found = np.empty_like(image)
        spline_at(spline, *_places(self, canvas), 12, found)
        return np.maximum(found, 0)  # a spline undershoots beside bright dots


@lru_cache(maxsize=2)  # a camera that is not moved has one canvas
def _places(left: Misalignment, canvas: Window) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns [h, w] of the ideal image that the pixels of the canvas see."""
    rng = np.random.default_rng([0x3EC7, left.seed])
    rows, columns = np.arange(canvas.height)[:, None], np.arange(canvas.width)
    at_v = rows - left.rows_px * smooth_field(canvas, left.cell_px, rng)
    return at_v, columns - left.columns_px * smooth_field(canvas, left.cell_px, rng)
