"""Loops over neighbours that numba compiles for this processor. Imported where numba is.

Each works on a range, so that threads can share it: of rows, or, where rows add up, of channels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

_SETTINGS: dict[str, Any] = {"nogil": True, "boundscheck": False, "error_model": "numpy"}


def _compiled(kernel: Callable[..., None]) -> Any:
    """At the first call for each type; kept beside this file, or in the user's cache."""
    try:
        return numba.njit(cache=True, **_SETTINGS)(kernel)
    except RuntimeError:  # neither folder can be written
        return numba.njit(**_SETTINGS)(kernel)


@_compiled
def neighbour_max(x: Any, index: Any, best: Any, where: Any, begin: int, end: int) -> None:
    """Maxima of x[index[i]] a channel and the first rows that have them; NaN is above all."""
    k, channels = index.shape[1], x.shape[1]
    for i in range(begin, end):
        most, at = best[i], where[i]
        row = index[i, 0]
        for c in range(channels):
            most[c] = x[row, c]
            at[c] = row
        for j in range(1, k):
            row = index[i, j]
            values = x[row]
            for c in range(channels):
                value = values[c]
                above = value > most[c] or value != value
                most[c] = value if above else most[c]
                at[c] = row if above else at[c]


@_compiled
def add_where(grad: Any, where: Any, out: Any, begin: int, end: int) -> None:
    """out[where[i, c], c] += grad[i, c], of these channels."""
    for i in range(grad.shape[0]):
        for c in range(begin, end):
            out[where[i, c], c] += grad[i, c]


@_compiled
def add_to_neighbours(x: Any, index: Any, out: Any, begin: int, end: int) -> None:
    """out[index[i, j]] += x[i], of these channels."""
    k = index.shape[1]
    for i in range(x.shape[0]):
        values = x[i]
        for j in range(k):
            row = out[index[i, j]]
            for c in range(begin, end):
                row[c] += values[c]
