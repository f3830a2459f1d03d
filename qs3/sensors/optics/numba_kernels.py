"""Loops over pixels, compiled. Imported only when needed: numba is slow to load."""

from typing import Any

import numpy as np

from qs3.utils.processor import compiled


@compiled
def spline_at(coefficients: Any, at_v: Any, at_u: Any, pad: int, out: Any) -> None:
    """Values of a cubic B-spline, to the bits of SciPy's `map_coordinates`.

    Args:
        coefficients: [H, W] float64, with `pad` more on each side than the image; 0 outside.
        at_v, at_u: [h, w] float64, places in the image.
        out: [h, w] float32, is filled.
    """
    height, width = coefficients.shape
    weights = np.empty((2, 4))
    for row in range(out.shape[0]):
        for col in range(out.shape[1]):
            v, u = at_v[row, col] + pad, at_u[row, col] + pad
            top, left = int(np.floor(v)) - 1, int(np.floor(u)) - 1
            for axis in range(2):
                y = v - np.floor(v) if axis == 0 else u - np.floor(u)
                z, own = 1 - y, weights[axis]
                own[1] = (y * y * (y - 2.0) * 3.0 + 4.0) / 6.0
                own[2] = (z * z * (z - 2.0) * 3.0 + 4.0) / 6.0
                own[0] = z * z * z / 6.0
                own[3] = 1.0 - own[0] - own[1] - own[2]
            total = 0.0
            for i in range(max(-top, 0), min(height - top, 4)):
                for j in range(max(-left, 0), min(width - left, 4)):
                    total += coefficients[top + i, left + j] * weights[0, i] * weights[1, j]
            out[row, col] = total
