"""Farthest point sampling (Eldar et al. 1997), compiled; exact in float32.

The points lie in buckets. A bucket whose farthest point a new sample does not come nearer to has
the same farthest point as before, so its other points wait until it does (Han et al., "QuickFPS",
IEEE TCAD 2023). Of equally far points the first in the order of the tree's first levels is taken:
2^3 buckets, 2^5 of more than 4,096 points, each halved at the mean of its longest side, or, below
96 points or up to 16 samples, the last of all. It is the order of fpsample 0.3.3, which chose the
points of earlier datasets.
"""

import numpy as np

from qs3.utils.processor import compiled

_PLAIN_BELOW, _PLAIN_UP_TO, _LARGE = 96, 16, 4096
_FINER = 2  # further levels, which change no order: buckets of 64 points in a cloud of 2,048


def farthest(cloud: np.ndarray, n: int, start: int) -> np.ndarray:
    """Indices [n] int64 of farthest points of a cloud [N, 3] float32, contiguous and finite.

    At distance zero, with all places taken, an index can come again.
    """
    plain = len(cloud) < _PLAIN_BELOW or n <= _PLAIN_UP_TO
    levels = 0 if plain else 3 if len(cloud) <= _LARGE else 5
    taken = np.empty(n, dtype=np.int64)
    _sample(cloud, start, levels, 0 if plain else _FINER, taken)
    return taken


@compiled
def _halved(cloud: np.ndarray, order: np.ndarray, ends: np.ndarray, levels: int) -> np.ndarray:
    """Sort `order` into 2^levels buckets for each one there is; their ends, beginning with 0."""
    for _ in range(levels):
        finer, count = np.zeros(2 * len(ends), dtype=np.int64), 0
        for bucket in range(len(ends) - 1):
            left, right = ends[bucket], ends[bucket + 1]
            if right - left > 1:
                axis, longest = 0, np.float32(0)
                for k in range(3):
                    low = high = cloud[order[left], k]
                    for i in range(left + 1, right):
                        low, high = min(low, cloud[order[i], k]), max(high, cloud[order[i], k])
                    if high - low > longest:
                        axis, longest = k, high - low
                mean = np.float32(0)
                for i in range(left, right):
                    mean += cloud[order[i], axis]
                mean /= np.float32(right - left)
                i, j = left, right - 1  # Hoare's partition
                while True:
                    while i <= j and cloud[order[i], axis] < mean:
                        i += 1
                    while i <= j and cloud[order[j], axis] >= mean:
                        j -= 1
                    if i > j:
                        break
                    order[i], order[j] = order[j], order[i]
                    i, j = i + 1, j - 1
                count += 1
                finer[count] = min(max(i, left + 1), right - 1)
            count += 1
            finer[count] = right
        ends = finer[: count + 1].copy()
    return ends


@compiled
def _sample(cloud: np.ndarray, start: int, levels: int, finer: int, taken: np.ndarray) -> None:
    total, n = len(cloud), len(taken)
    order = np.arange(total) if levels else np.arange(total - 1, -1, -1)
    ends = _halved(cloud, order, np.array([0, total]), levels)
    rank = np.empty(total, dtype=np.int64)
    rank[order] = np.arange(total)
    ends = _halved(cloud, order, ends, finer)
    rank, buckets = rank[order], len(ends) - 1
    xyz = np.ascontiguousarray(cloud[order].T)
    x, y, z = xyz[0], xyz[1], xyz[2]
    low, high = np.empty((buckets, 3), np.float32), np.empty((buckets, 3), np.float32)
    for b in range(buckets):
        for k in range(3):
            side = xyz[k, ends[b] : ends[b + 1]]
            low[b, k], high[b, k] = side.min(), side.max()
    nearest = np.full(total, np.inf, dtype=np.float32)  # squared, to what is taken
    far, at = np.full(buckets, np.inf, dtype=np.float32), ends[:-1].copy()
    waiting, count = np.empty((buckets, n), np.int32), np.zeros(buckets, np.int64)
    new = np.empty((n, 3), np.float32)
    new[0], taken[0] = cloud[start], start
    for s in range(n - 1):
        u, v, w = new[s, 0], new[s, 1], new[s, 2]
        best = 0
        for b in range(buckets):
            a = at[b]
            waiting[b, count[b]] = s
            if s and (x[a] - u) ** 2 + (y[a] - v) ** 2 + (z[a] - w) ** 2 > far[b]:
                beside = np.float32(0)
                for k in range(3):
                    beside += max(low[b, k] - new[s, k], new[s, k] - high[b, k], np.float32(0)) ** 2
                count[b] += beside < far[b]
            else:
                for one in waiting[b, : count[b] + 1]:
                    xx, yy, zz = new[one, 0], new[one, 1], new[one, 2]
                    for i in range(ends[b], ends[b + 1]):
                        d = (x[i] - xx) ** 2 + (y[i] - yy) ** 2 + (z[i] - zz) ** 2
                        nearest[i] = d if d < nearest[i] else nearest[i]
                count[b] = 0
                a = ends[b]
                for i in range(ends[b] + 1, ends[b + 1]):
                    if nearest[i] > nearest[a] or (nearest[i] == nearest[a] and rank[i] < rank[a]):
                        a = i
                at[b], far[b] = a, nearest[a]
            if far[b] > far[best] or (far[b] == far[best] and rank[at[b]] < rank[at[best]]):
                best = b
        a = at[best]
        taken[s + 1] = order[a]
        new[s + 1, 0], new[s + 1, 1], new[s + 1, 2] = x[a], y[a], z[a]
