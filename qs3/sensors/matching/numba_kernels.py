"""Loops over scores of disparities, compiled. Imported only when needed: numba is slow to load."""

from typing import Any

import numpy as np

from qs3.utils.processor import compiled


@compiled
def to_correlation(
    product: Any, mean_a: Any, mean_b: Any, spread_a: Any, spread_b: Any, out: Any
) -> None:
    """Normalised correlation from means and spreads of windows, all [h, w] float32; into `out`."""
    for row in range(out.shape[0]):
        for col in range(out.shape[1]):
            covariance = product[row, col] - mean_a[row, col] * mean_b[row, col]
            out[row, col] = covariance / (spread_a[row, col] * spread_b[row, col])


@compiled
def best_and_second(scores: Any, best: Any, beside: Any) -> None:
    """The winner's place, and the scores that decide whether it counts.

    Args:
        scores: [n, h, w] float32, not NaN.
        best: [h, w] int32, gets the first place of the highest score.
        beside: [4, h, w] float32, gets the highest score, its two neighbours' (at an end its own),
            and the highest of all more than 2 places away, at least -1.
    """
    n, height, width = scores.shape
    none, two = np.float32(-1), np.int32(2)
    for row in range(height):
        place, top, second = best[row], beside[0, row], beside[3, row]
        for col in range(width):
            place[col], top[col], second[col] = 0, scores[0, row, col], none
        for k in range(0, n, 4):  # four at a time; the last one may come again
            k_a, k_b = np.int32(k), np.int32(min(k + 1, n - 1))
            k_c, k_d = np.int32(min(k + 2, n - 1)), np.int32(min(k + 3, n - 1))
            a, b, c, d = scores[k_a, row], scores[k_b, row], scores[k_c, row], scores[k_d, row]
            for col in range(width):
                value, at = top[col], place[col]
                above = a[col] > value
                value, at = (a[col], k_a) if above else (value, at)
                above = b[col] > value
                value, at = (b[col], k_b) if above else (value, at)
                above = c[col] > value
                value, at = (c[col], k_c) if above else (value, at)
                above = d[col] > value
                value, at = (d[col], k_d) if above else (value, at)
                top[col], place[col] = value, at
        for k in range(0, n, 4):
            k_a, k_b = np.int32(k), np.int32(min(k + 1, n - 1))
            k_c, k_d = np.int32(min(k + 2, n - 1)), np.int32(min(k + 3, n - 1))
            a, b, c, d = scores[k_a, row], scores[k_b, row], scores[k_c, row], scores[k_d, row]
            for col in range(width):
                value, at = second[col], place[col]
                score = a[col] if abs(np.int32(at - k_a)) > two else none
                value = score if score > value else value
                score = b[col] if abs(np.int32(at - k_b)) > two else none
                value = score if score > value else value
                score = c[col] if abs(np.int32(at - k_c)) > two else none
                value = score if score > value else value
                score = d[col] if abs(np.int32(at - k_d)) > two else none
                second[col] = score if score > value else value
        for col in range(width):
            here = place[col]
            beside[1, row, col] = scores[max(here - 1, 0), row, col]
            beside[2, row, col] = scores[min(here + 1, n - 1), row, col]
