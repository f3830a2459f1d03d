"""Scores of disparities: their correlation, which one is the highest, and by how much.

By compiled loops where numba is, with the same values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qs3.utils.jit import has_numba


def correlation(
    product: np.ndarray,
    means: tuple[np.ndarray, np.ndarray],
    spreads: tuple[np.ndarray, np.ndarray],
    out: np.ndarray,
) -> None:
    """Normalised correlation of two images' windows.

    Args:
        product: [h, w] float32, mean of the windows' product.
        means, spreads: [h, w] float32 each, of one image's windows and of the other's.
        out: [h, w] float32, gets it.
    """
    if has_numba():
        from qs3.sensors.matching.numba_kernels import to_correlation

        to_correlation(product, *means, *spreads, out)
    else:
        out[:] = (product - means[0] * means[1]) / (spreads[0] * spreads[1])


@dataclass(frozen=True, eq=False)
class Winner:
    """The highest of the scores of each pixel.

    Attributes:
        place: [h, w] integers, the first that has it.
        top: [h, w] float32, the score.
        lower, upper: [h, w] float32, its neighbours'; at an end of the search its own.
        second: [h, w] float32, the highest more than 2 places away; at least -1.
    """

    place: np.ndarray
    top: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    second: np.ndarray


def winner(scores: np.ndarray) -> Winner:
    """The highest of scores [n, h, w] float32 without NaN."""
    if not has_numba():
        return _winner_by_numpy(scores)
    from qs3.sensors.matching.numba_kernels import best_and_second

    place = np.empty(scores.shape[1:], dtype=np.int32)
    beside = np.empty((4, *place.shape), dtype=np.float32)
    best_and_second(scores, place, beside)
    return Winner(place, *beside)


def _winner_by_numpy(scores: np.ndarray) -> Winner:
    last = len(scores) - 1
    place = scores.argmax(axis=0)

    def score_at(index: np.ndarray) -> np.ndarray:
        return np.take_along_axis(scores, index[None], axis=0)[0]

    top = score_at(place)
    lower, upper = score_at(np.maximum(place - 1, 0)), score_at(np.minimum(place + 1, last))
    # The runner-up: blank the winner's neighbourhood and look again.
    others = scores.copy()
    for near in range(-2, 3):
        np.put_along_axis(others, np.clip(place + near, 0, last)[None], -1, axis=0)
    return Winner(place, top, lower, upper, others.max(axis=0))
