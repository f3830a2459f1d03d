"""Which pixels of a mask hang together in depth: pieces that a depth jump separates."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from qs3.datasets.frames.rules import Rules

_LEAST_PX = 20  # a piece below is dust: it is joined to nothing
_MOST_PIECES = 40  # looked at, the largest first
_SAMPLE = 2000  # points of a piece that the gap to others is measured with


def pieces(
    measured: Bool[np.ndarray, "h w"], depth_m: Float[np.ndarray, "h w"], rules: Rules
) -> Int[np.ndarray, "h w"]:
    """Number of each measured pixel's piece, the largest first (0, 1, ...); -1 elsewhere.

    Pixels next to each other in a row or column are of one piece unless their depth jumps; so are
    the two ends of a hole of at most `rules.bridge_px`.
    """
    count = int(measured.sum())
    number = np.full(measured.shape, -1, dtype=np.int64)
    if count == 0:
        return number
    number[measured] = np.arange(count)
    edges = []
    for pixels, depth in ((number, depth_m), (number.T, depth_m.T)):
        row, column = np.nonzero(pixels >= 0)  # along rows, from left to right
        z = depth[row, column]
        gap = column[1:] - column[:-1]
        jump = np.abs(z[1:] - z[:-1])
        allowed = np.maximum(rules.jump_m, rules.jump_share * np.minimum(z[1:], z[:-1]))
        near = (row[1:] == row[:-1]) & (gap <= rules.bridge_px + 1) & (jump <= allowed)
        index = pixels[row, column]
        edges.append(np.stack([index[1:][near], index[:-1][near]]))
    a, b = np.concatenate(edges, axis=1)
    graph = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(count, count))
    _, piece = connected_components(graph, directed=False)
    sizes = np.bincount(piece)
    order = np.argsort(-sizes, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    number[measured] = rank[piece]
    return number


def body(
    piece: Int[np.ndarray, "h w"], points_m: Float[np.ndarray, "h w 3"], rules: Rules
) -> Bool[np.ndarray, "h w"]:
    """The largest piece with all that lie within `rules.join_m` of it, directly or by others.

    An arm of a chair jumps out before its seat but is near it in space; the wall behind is not.
    """
    kept = piece == 0
    if not kept.any():
        return kept
    sizes = np.bincount(piece[piece >= 0])
    waiting = [k for k in range(1, min(len(sizes), _MOST_PIECES)) if sizes[k] >= _LEAST_PX]
    samples = {k: _some(points_m[piece == k]) for k in (0, *waiting)}
    newest, waiting = [0], list(waiting)
    while newest and waiting:
        tree = cKDTree(np.concatenate([samples[k] for k in newest]))
        newest = [k for k in waiting if tree.query(samples[k])[0].min() <= rules.join_m]
        waiting = [k for k in waiting if k not in newest]
        for k in newest:
            kept |= piece == k
    return kept


def _some(points: np.ndarray) -> np.ndarray:
    """At most so many of them, evenly."""
    return points[:: max(1, len(points) // _SAMPLE)]
