"""What `cutting` does pixel by pixel, compiled."""

import numpy as np

from qs3.utils.processor import compiled


@compiled
def connected(
    depth_m: np.ndarray, measured: np.ndarray, jump_m: float, jump_share: float, bridge_px: int
) -> np.ndarray:
    """Number of each measured pixel's piece [h, w] int64, by its first pixel; -1 elsewhere.

    Measured pixels that follow each other in a row or column, at most `bridge_px` others between
    them, are of one piece unless their depths differ by more than the larger of `jump_m` and
    `jump_share` of the nearer one.
    """
    height, width = measured.shape
    parent = np.arange(height * width)
    for turn in range(2):
        lines, length = (height, width) if turn == 0 else (width, height)
        for line in range(lines):
            last = -1
            for k in range(length):
                i, j = (line, k) if turn == 0 else (k, line)
                if not measured[i, j]:
                    continue
                if last >= 0 and k - last <= bridge_px + 1:
                    a, b = (line, last) if turn == 0 else (last, line)
                    z, other = depth_m[i, j], depth_m[a, b]
                    if abs(z - other) <= max(jump_m, jump_share * min(z, other)):
                        first, second = i * width + j, a * width + b
                        while parent[first] != first:
                            parent[first] = parent[parent[first]]
                            first = parent[first]
                        while parent[second] != second:
                            parent[second] = parent[parent[second]]
                            second = parent[second]
                        parent[max(first, second)] = min(first, second)
                last = k
    number = np.full((height, width), -1, dtype=np.int64)
    count = 0
    for place in range(height * width):
        i, j = place // width, place % width
        if measured[i, j]:
            root = place
            while parent[root] != root:
                root = parent[root]
            if root == place:
                number[i, j] = count
                count += 1
            else:  # the first pixel of a piece comes first
                number[i, j] = number[root // width, root % width]
    return number
