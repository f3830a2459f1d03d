"""Loops over neighbours that numba compiles for this processor. Imported at the first call.

Each works on a range, so that threads can share it: of rows, or, where rows add up, of channels.
Inner loops begin at 0: an index that may be negative keeps LLVM from using vectors.
"""

from typing import Any

import numpy as np

from qs3.utils.processor import compiled


@compiled
def neighbour_max(x: Any, index: Any, best: Any, where: Any, begin: int, end: int) -> None:
    """Maxima of x[index[i]] a channel and the first rows that have them; NaN is above all.

    Four rows at a time: what is best so far is then read and written a quarter as often. The last
    row may come again, which changes nothing.
    """
    k, channels = index.shape[1], x.shape[1]
    for i in range(begin, end):
        most, at, first = best[i], where[i], x[index[i, 0]]
        for channel in range(channels):
            most[channel] = first[channel]
            at[channel] = index[i, 0]
        for j in range(1, k, 4):
            row_a = np.int32(index[i, j])
            row_b = np.int32(index[i, min(j + 1, k - 1)])
            row_c = np.int32(index[i, min(j + 2, k - 1)])
            row_d = np.int32(index[i, min(j + 3, k - 1)])
            a, b, c, d = x[row_a], x[row_b], x[row_c], x[row_d]
            for channel in range(channels):
                value, row = most[channel], at[channel]
                above = (a[channel] > value) | (a[channel] != a[channel])
                value, row = (a[channel], row_a) if above else (value, row)
                above = (b[channel] > value) | (b[channel] != b[channel])
                value, row = (b[channel], row_b) if above else (value, row)
                above = (c[channel] > value) | (c[channel] != c[channel])
                value, row = (c[channel], row_c) if above else (value, row)
                above = (d[channel] > value) | (d[channel] != d[channel])
                value, row = (d[channel], row_d) if above else (value, row)
                most[channel], at[channel] = value, row


@compiled
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


@compiled
def kth_smallest(bits: Any, limits: Any, bound: Any, begin: int, end: int) -> None:
    """The k-th smallest number of each row, by halving the range that it lies in; NaN is above all.

    As whole numbers the bits of floats have their order once those of negative ones are turned.
    `bits` [r, n] are those of float32 or float64, as `bound` [r] of what is found; `limits` [3] are
    the type's largest number, the bits of infinity, and k.
    """
    kind = bits.dtype.type  # each result is cast: else numbers, and with them vectors, are of int64
    top, infinite, k = limits[0], limits[1], limits[2]
    zero, one = kind(0), kind(1)
    keys = np.empty_like(bits[0])
    for i in range(begin, end):
        row = bits[i]
        low, high = top, kind(~top)
        for g in range(len(row)):
            key = row[g] if row[g] >= zero else kind(row[g] ^ top)
            keys[g] = key if kind(row[g] & top) <= infinite else top
            low, high = min(low, keys[g]), max(high, keys[g])
        while low < high:
            middle = kind((low & high) + ((low ^ high) >> 1))  # rounded down, and never too large
            number = zero
            for g in range(len(row)):
                number = kind(number + (keys[g] <= middle))
            if number == k:
                high = low
                for g in range(len(row)):
                    high = max(high, keys[g] if keys[g] <= middle else low)
                low = high
            elif number > k:
                high = middle
            else:
                low = kind(middle + one)
        bound[i] = low if low >= zero else kind(low ^ top)


@compiled
def collect_below(
    values: Any, minima: Any, bound: Any, few: Any, column: Any, count: Any, begin: int, end: int
) -> None:
    """Values up to a row's bound and their columns, in order; the places behind them get inf.

    `few` and `column` have as many places as may be in, and a turn more; a greater count says that
    they were too few.
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


@compiled
def take_in_order(few: Any, column: Any, count: Any, out: Any, begin: int, end: int) -> None:
    """Columns of the smallest of count[i] values, smallest first, and of equal ones the first.

    None is NaN. A value's place is how many are below it: of a few all comparisons take less time
    than a sort.
    """
    k = out.shape[1]
    a_few = 4 * k
    place, rank = np.empty(a_few, np.int32), np.empty(a_few, np.int32)
    best = np.empty(k, few.dtype)
    for a in range(a_few):
        place[a] = a
    for i in range(begin, end):
        values, width = few[i], max(count[i], k)
        if width > a_few:  # many that are equal: each goes where it belongs, mostly nowhere
            for a in range(width):
                j = min(a, k - 1)
                if a < k or values[a] < best[j]:
                    while j > 0 and values[a] < best[j - 1]:
                        best[j] = best[j - 1]
                        out[i, j] = out[i, j - 1]
                        j -= 1
                    best[j] = values[a]
                    out[i, j] = column[i, a]
            continue
        for a in range(width):
            rank[a] = 0
        for b in range(width):
            value, at = values[b], np.int32(b)
            for a in range(width):
                is_before = (value < values[a]) | ((value == values[a]) & (at < place[a]))
                rank[a] = np.int32(rank[a] + is_before)
        for a in range(width):
            if rank[a] < k:
                out[i, rank[a]] = column[i, a]


@compiled
def add_where(grad: Any, where: Any, out: Any, begin: int, end: int) -> None:
    """out[where[i, c], c] += grad[i, c], of these channels."""
    for i in range(grad.shape[0]):
        rows, values = where[i, begin:end], grad[i, begin:end]
        for c in range(len(rows)):
            out[rows[c], begin + c] += values[c]


@compiled
def add_to_neighbours(x: Any, index: Any, out: Any, begin: int, end: int) -> None:
    """out[index[i, j]] += x[i], of these channels."""
    k = index.shape[1]
    for i in range(x.shape[0]):
        values = x[i, begin:end]
        for j in range(k):
            row = out[index[i, j], begin:end]
            for c in range(len(row)):
                row[c] += values[c]


@compiled
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
