"""Semi-global aggregation of matching costs along straight paths.

Hirschmueller, Stereo processing by semiglobal matching and mutual information, PAMI 2008,
section 2.3: along a path r, with p the pixel before on it,

    L(d) = C(d) + min(L_p(d), L_p(d - 1) + P1, L_p(d + 1) + P1, min L_p + P2) - min L_p

and the sum of L over all paths takes the place of C.
"""

from __future__ import annotations

import numpy as np

STRIP_ROWS = 64
"""Rows that are turned at a time for the horizontal paths: some MB, which a cache holds."""


def aggregate(
    cost: np.ndarray,
    small: int,
    large: int,
    paths: int,
    guide: np.ndarray | None = None,
    edge_grey: float = 0.0,
) -> np.ndarray:
    """Sum of the path costs.

    Args:
        cost: [h, w, D] uint16; paths * (largest cost + large) must be below 65536.
        small: P1, for a step of one disparity between neighbours.
        large: P2, for any larger step.
        paths: 4 (along rows and columns) or 8 (and diagonals).
        guide: [h, w] grey values; with `edge_grey` g > 0, P2 between two pixels that differ by
            a grey values is P2 / (1 + a / g), and at least P1.
        edge_grey: see `guide`; 0 switches it off.

    Returns:
        [h, w, D] uint16.
    """
    total = np.zeros_like(cost)
    grey = None if guide is None or edge_grey <= 0 else guide.astype(np.float32)
    sideways = (-1, 0, 1) if paths == 8 else (0,)
    for shift in sideways:
        for flip in (slice(None), slice(None, None, -1)):
            picture = None if grey is None else grey[flip]
            _sweep(cost[flip], total[flip], small, large, shift, picture, edge_grey)
    for top in range(0, len(cost), STRIP_ROWS):
        rows = slice(top, top + STRIP_ROWS)
        turned = np.ascontiguousarray(cost[rows].transpose(1, 0, 2))
        total_turned = np.zeros_like(turned)
        for flip in (slice(None), slice(None, None, -1)):
            picture = None if grey is None else grey[rows].T[flip]
            _sweep(turned[flip], total_turned[flip], small, large, 0, picture, edge_grey)
        total[rows] += total_turned.transpose(1, 0, 2)
    return total


def _sweep(
    cost: np.ndarray,
    total: np.ndarray,
    small: int,
    large: int,
    shift: int,
    grey: np.ndarray | None,
    edge_grey: float,
) -> None:
    """Add to `total` the costs of paths that step from line i - 1, place m - shift to i, m.

    Args:
        cost, total: [lines, places, D] uint16.
        grey: [lines, places] float32 or None.
    """
    lines, places, _ = cost.shape
    p1, p2 = np.uint16(small), np.uint16(large)
    # Kept with its minimum at 0, so that min L_p drops out; zero, as before the first line, at
    # both ends, where diagonals enter.
    kept = np.zeros((places + 2, cost.shape[2]), dtype=np.uint16)
    before = kept[1 - shift : 1 - shift + places]
    here = kept[1:-1]
    best = np.empty_like(here)
    step = np.empty_like(here)
    steps = None if grey is None else _modulated(grey, small, large, shift, edge_grey)
    for i in range(lines):
        np.minimum(before, p2 if steps is None else steps[i], out=best)
        np.add(before, p1, out=step)
        np.minimum(best[:, 1:], step[:, :-1], out=best[:, 1:])
        np.minimum(best[:, :-1], step[:, 1:], out=best[:, :-1])
        best += cost[i]
        total[i] += best
        np.subtract(best, best.min(axis=1, keepdims=True), out=here)


def _modulated(
    grey: np.ndarray, small: int, large: int, shift: int, edge_grey: float
) -> np.ndarray:
    """[lines, places, 1] uint16 P2 for the step to each place; on the first line any."""
    steps = np.full(grey.shape, large, dtype=np.uint16)
    places = grey.shape[1]
    to = slice(max(0, shift), places + min(0, shift))
    of = slice(max(0, -shift), places + min(0, -shift))
    change = np.abs(grey[1:, to] - grey[:-1, of])
    steps[1:, to] = np.maximum(small, np.rint(large / (1 + change / np.float32(edge_grey))))
    return steps[..., None]
