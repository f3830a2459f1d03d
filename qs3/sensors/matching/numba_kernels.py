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


@compiled
def census_bits(padded: Any, half: int, words: Any) -> None:
    """Set the bits of census strings; see `census.census`.

    Args:
        padded: [h + 2 half, w + 2 half], uint8 or float32.
        half: of the window.
        words: [n, h, w] uint64, 0 before.
    """
    _, height, width = words.shape
    side = 2 * half + 1
    for row in range(height):
        middle = padded[row + half, half : half + width]
        for place in range(side * side):
            bit = place - (place > side * side // 2)
            if place == side * side // 2:
                continue
            word, one = words[bit // 64, row], np.uint64(1) << np.uint64(bit % 64)
            line = padded[row + place // side, place % side : place % side + width]
            for col in range(width):
                word[col] |= one if line[col] > middle[col] else np.uint64(0)


@compiled
def _hamming(word: Any, other: Any, begin: int, end: int, worst: Any, cost: Any) -> None:
    """Bits in which the strings [n, w] and [n, w + D - 1] of a row differ, into [w, D] uint16."""
    twos, fours = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
    eights, ones = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)
    one, two, four, top = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)
    width, count = cost.shape
    for u in range(width):
        place = cost[u]
        place[:] = 0
        for k in range(len(word)):
            here, there = word[k, u], other[k, u : u + count]
            for j in range(count):  # Warren, Hacker's Delight, section 5-1
                x = here ^ there[j]
                x = x - ((x >> one) & twos)
                x = (x & fours) + ((x >> two) & fours)
                x = (((x + (x >> four)) & eights) * ones) >> top
                place[j] = np.uint16(place[j] + np.uint16(x))
        place[: min(max(begin - u, 0), count)] = worst
        place[min(max(end - u, 0), count) :] = worst


@compiled
def _mirrored(at: int, length: int) -> int:
    """The place [0, length) of one beyond the border, mirrored about the outermost."""
    while length > 1 and not 0 <= at < length:
        at = -at if at < 0 else 2 * (length - 1) - at
    return at if length > 1 else 0


@compiled
def _exchange(total: Any, new: Any, old: Any, sign: Any) -> None:
    """Add `new` to sums [n] uint16 and take away `old`, times `sign` (0 or 1)."""
    for j in range(len(total)):
        total[j] = np.uint16(total[j] + new[j] - np.uint16(old[j] * sign))


@compiled
def block_costs(
    words: Any, others: Any, begin: int, end: int, worst: Any, half: int, cost: Any
) -> None:
    """Count the bits in which census strings differ, summed over blocks; the border is mirrored.

    Args:
        words: [n, h, w] uint64.
        others: [n, h, w + D - 1] uint64; place j of pixel u is column u + j.
        begin, end: columns that the other image has; elsewhere a pixel's cost is `worst`.
        half: the side of a block is 2 half + 1.
        cost: [h, w, D] uint16, is filled.
    """
    height, width, count = cost.shape
    size = 2 * half + 2
    rows = np.zeros((size, width, count), np.uint16)  # of pixels, by row modulo size
    none, one = np.uint16(0), np.uint16(1)
    column, total = np.zeros((width, count), np.uint16), np.empty(count, np.uint16)
    done = 0
    for row in range(height):
        while done < min(row + half + 1, height):
            _hamming(words[:, done], others[:, done], begin, end, worst, rows[done % size])
            done += 1
        for k in range(-half if row == 0 else half, half + 1):
            new = rows[_mirrored(row + k, height) % size]
            old = rows[_mirrored(row - half - 1, height) % size]
            _exchange(column.reshape(-1), new.reshape(-1), old.reshape(-1), one if row else none)
        total[:] = 0
        for u in range(-2 * half, width):
            old = column[_mirrored(u - half - 1, width)]
            new = column[_mirrored(u + half, width)]
            sign, out = one if u > 0 else none, cost[row, max(u, 0)]
            for j in range(count):
                total[j] = np.uint16(total[j] + new[j] - np.uint16(old[j] * sign))
                out[j] = total[j]


@compiled
def _step(before: Any, cost: Any, total: Any, drop: Any, p1: Any, p2: Any, new: Any) -> None:
    """Go on by a pixel on a path; `before` [D + 2] begins and ends with P2, its minimum is 0."""
    count = len(cost)
    low = np.uint16(65535)
    for j in range(count):
        near = np.uint16(min(before[j], before[j + 2]) + p1)
        value = np.uint16(min(min(before[j + 1], near), p2) + (cost[j] >> drop))
        total[j] = np.uint16(total[j] + value)
        new[j] = value
        low = min(low, value)
    for j in range(count):
        before[j + 1] = np.uint16(new[j] - low)


@compiled
def path_sums(cost: Any, drop: Any, p1: Any, p2: Any, total: Any) -> None:
    """Sum of the semi-global costs of four paths, along rows and columns and both ways.

    Args:
        cost: [h, w, D] uint16.
        drop: bits of it that are left out, uint16.
        p1, p2: for a step of one disparity between neighbours, and for any larger one, uint16;
            4 * (largest cost + p2) must be below 65536.
        total: [h, w, D] uint16, is filled.
    """
    height, width, count = cost.shape
    line, above = np.empty(count + 2, np.uint16), np.empty((width, count + 2), np.uint16)
    new = np.empty(count, np.uint16)
    for way in range(2):
        above[:] = 0
        above[:, 0], above[:, -1] = p2, p2
        for i in range(height):
            row = height - 1 - i if way else i
            costs, totals = cost[row], total[row]
            if way == 0:
                totals[:] = 0
                for back in range(2):
                    line[:] = 0
                    line[0], line[-1] = p2, p2
                    for k in range(width):
                        u = width - 1 - k if back else k
                        _step(line, costs[u], totals[u], drop, p1, p2, new)
            for u in range(width):
                _step(above[u], costs[u], totals[u], drop, p1, p2, new)


@compiled
def cheapest(total: Any, cost: Any, best: Any, beside: Any, back: Any) -> None:
    """The place of the lowest sum, and what decides whether it counts.

    Args:
        total, cost: [h, w, D] uint16.
        best: [h, w] int32, gets the first place of the lowest total.
        beside: [5, h, w] float32, gets the costs at the place below, there and above (at an end the
            end's own), the total there, and the lowest total of those that are not its neighbours.
        back: [h, w + D - 1] int32, gets for each column x of the other image the place j of the
            lowest total[v, x - j, j], the lowest j of several.
    """
    height, width, count = total.shape
    low = np.empty(width + count - 1, np.uint16)
    for row in range(height):
        low[:], back[row] = 65535, 0
        for k in range(width):
            u = width - 1 - k
            place, there, at = total[row, u], low[u : u + count], back[row, u : u + count]
            least = np.uint16(65535)
            for j in range(count):
                better = place[j] < there[j]
                at[j] = np.int32(j) if better else at[j]
                there[j] = min(place[j], there[j])
                least = min(least, place[j])
            here = 0
            while place[here] != least:
                here += 1
            second = np.uint16(65535)
            for j in range(count):
                second = min(second, place[j] if abs(j - here) > 1 else np.uint16(65535))
            best[row, u] = here
            for step in range(3):
                beside[step, row, u] = cost[row, u, min(max(here + step - 1, 0), count - 1)]
            beside[3, row, u], beside[4, row, u] = least, second


@compiled
def smooth_lines(lines: Any, alpha: Any, most: Any) -> None:
    """Smooth each line of [n, w] float32 forwards and backwards; see `filters.SpatialFilter`."""
    rest = np.float32(1) - alpha
    for row in range(lines.shape[0]):
        line = lines[row]
        for i in range(1, len(line)):
            if abs(line[i] - line[i - 1]) <= most:  # false for NaN
                line[i] = alpha * line[i] + rest * line[i - 1]
        for i in range(len(line) - 2, -1, -1):
            if abs(line[i] - line[i + 1]) <= most:
                line[i] = alpha * line[i] + rest * line[i + 1]
