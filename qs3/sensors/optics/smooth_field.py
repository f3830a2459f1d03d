"""Smooth random fields over the pixels of an image: errors that neighbours share."""

from __future__ import annotations

import numpy as np

from qs3.geometry.cameras import Window

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
