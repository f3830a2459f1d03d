"""Loops over neighbours that numba compiles for this processor. Imported where numba is.

Each works on a range, so that threads can share it: of rows, or, where rows add up, of channels.
Inner loops begin at 0: an index that may be negative keeps LLVM from using vectors.
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
        rows, values = where[i, begin:end], grad[i, begin:end]
        for c in range(len(rows)):
            out[rows[c], begin + c] += values[c]


@_compiled
def add_to_neighbours(x: Any, index: Any, out: Any, begin: int, end: int) -> None:
    """out[index[i, j]] += x[i], of these channels."""
    k = index.shape[1]
    for i in range(x.shape[0]):
        values = x[i, begin:end]
        for j in range(k):
            row = out[index[i, j], begin:end]
            for c in range(len(row)):
                row[c] += values[c]


@_compiled
def add_products(
    x: Any, weight: Any, grad: Any, where: Any, dx: Any, dweight: Any, begin: int, end: int
) -> None:
    """dx[b, where] += grad * weight[d] and dweight[d] += grad * x[b, where], of these channels."""
    for b in range(grad.shape[0]):
        for d in range(grad.shape[1]):
            factor = grad[b, d]
            row = where[b, d]
            of_x, of_weight = x[b, row, begin:end], weight[d, begin:end]
            to_x, to_weight = dx[b, row, begin:end], dweight[d, begin:end]
            for c in range(len(of_x)):
                to_x[c] += factor * of_weight[c]
                to_weight[c] += factor * of_x[c]
