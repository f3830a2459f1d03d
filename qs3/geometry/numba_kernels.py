"""Loops over neighbours that numba compiles for this processor. Imported where numba is.

Each works on a range, so that threads can share it: of rows, or, where rows add up, of channels.
Inner loops begin at 0: an index that may be negative keeps LLVM from using vectors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

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
def add_and_minima(values: Any, more: Any, minima: Any, begin: int, end: int) -> None:
    """values[i] += more[i // r], r rows a cloud; and the least of each group of columns.

    Columns are dealt to the groups in turn; those that do not fill a turn have none. The least of a
    group with a NaN is NaN.
    """
    groups, turns = minima.shape[1], values.shape[1] // minima.shape[1]
    rows = values.shape[0] // more.shape[0]
    for i in range(begin, end):
        least, other = minima[i], more[i // rows]
        for g in range(groups):
            least[g] = np.inf
        for turn in range(turns):
            row, added = values[i, turn * groups :], other[turn * groups :]
            for g in range(groups):
                value = row[g] + added[g]
                row[g] = value
                least[g] = value if value < least[g] or value != value else least[g]
        for j in range(turns * groups, values.shape[1]):
            values[i, j] += other[j]


@_compiled
def collect_below(
    values: Any, minima: Any, bound: Any, few: Any, column: Any, count: Any, begin: int, end: int
) -> None:
    """Values up to a row's bound and their columns, in order; the places behind them get inf.

    `few` and `column` have as many places as may be in, and a turn more to be written to. A count
    that is greater says that they were too few.
    """
    groups, turns = minima.shape[1], values.shape[1] // minima.shape[1]
    places = few.shape[1] - groups
    chosen = np.empty(groups, np.int64)
    for i in range(begin, end):
        row, most, kept, where = values[i], bound[i], few[i], column[i]
        number = 0
        for g in range(groups):
            chosen[number] = g
            number += not minima[i, g] > most
        found = 0
        for turn in range(turns):
            for g in range(number):
                j = turn * groups + chosen[g]
                kept[found] = row[j]
                where[found] = j
                found += row[j] <= most
            if found > places:
                break
        if found <= places:
            for j in range(turns * groups, len(row)):
                if row[j] <= most:
                    kept[found] = row[j]
                    where[found] = j
                    found += 1
        count[i] = found
        for j in range(found, places):
            kept[j] = np.inf
            where[j] = 0


@_compiled
def take_in_order(column: Any, order: Any, out: Any, begin: int, end: int) -> None:
    """out[i, j] = column[i, order[i, j]]."""
    for i in range(begin, end):
        for j in range(out.shape[1]):
            out[i, j] = column[i, order[i, j]]


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
