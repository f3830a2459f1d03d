"""Ball query (PointNet++, Qi et al., NeurIPS 2017): the first points within a radius.

As in the authors' kernel: a point belongs to a ball if its distance is strictly less than the
radius; points are taken in the order of their indices, not of their distances; a ball with fewer
than `count` of them is filled up with the first one. So the result depends on the order of the
points, and a full ball is a biased sample of its neighbourhood.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from qs3.kernels.device import exporting, takes_numpy

_BLOCK = 1 << 26  # distances held at once on a device: 256 MB in float32
_CPU_BLOCK = 1 << 18  # 1 MB in float32, to stay in the cache


def ball_query(
    points: Float[Tensor, "b n 3"],
    centres: Float[Tensor, "b m 3"],
    radius: float,
    count: int,
) -> Int[Tensor, "b m k"]:
    """Indices of the first `count` points of each ball; see `ball_queries`."""
    return ball_queries(points, centres, [radius], [count])[0]


def ball_queries(
    points: Float[Tensor, "b n 3"],
    centres: Float[Tensor, "b m 3"],
    radii: Sequence[float],
    counts: Sequence[int],
) -> list[Int[Tensor, "b m k"]]:
    """Balls of several radii about the same centres; distances are computed once.

    Args:
        points: the points to search, in any unit, in the dtype in which distances are compared
            (float32 at least, also under autocast).
        centres: of the balls.
        radii: one a query, in the same unit, > 0.
        counts: indices in a ball of each query, >= 1.

    Returns:
        For each query [B, M, count] int64. A ball without points holds the index of the point
        nearest to its centre.
    """
    with torch.no_grad(), torch.autocast(points.device.type, enabled=False):
        if points.dtype in (torch.float16, torch.bfloat16):
            points, centres = points.float(), centres.float()
        if exporting():  # blocks would bind the graph to a number of clouds
            squares = _squared_distances(points, centres)
            queries = zip(radii, counts, strict=True)
            return [_first(squares < r * r, squares, k) for r, k in queries]
        b, n, _ = points.shape
        m = centres.shape[1]
        out = [torch.empty(b, m, k, dtype=torch.int64, device=points.device) for k in counts]
        on_cpu = takes_numpy(points)
        rows = max(1, min(m, (_CPU_BLOCK if on_cpu else _BLOCK) // n))
        clouds = max(1, (_CPU_BLOCK if on_cpu else _BLOCK) // (n * rows))
        for i in range(0, b, clouds):
            for j in range(0, m, rows):
                squares = _squared_distances(
                    points[i : i + clouds], centres[i : i + clouds, j : j + rows]
                )
                for index, radius, k in zip(out, radii, counts, strict=True):
                    first = _first_on_cpu if on_cpu else _first
                    found = first(squares < radius * radius, squares, k)
                    index[i : i + clouds, j : j + rows] = found
        return out


def _squared_distances(points: Tensor, centres: Tensor) -> Tensor:
    """[b, m, n], coordinate by coordinate: |x|^2 - 2xy + |y|^2 would misjudge the ball's rim."""
    squares = (centres[:, :, None, 0] - points[:, None, :, 0]).square_()
    for axis in (1, 2):
        difference = centres[:, :, None, axis] - points[:, None, :, axis]
        squares.addcmul_(difference, difference)
    return squares


def _first(inside: Tensor, squares: Tensor, k: int) -> Tensor:
    """[b, m, k] the first k columns that are True, without a loop or a wait for the device."""
    rank = inside.cumsum(2, dtype=torch.int32) - 1  # of each point in its ball
    slot = torch.where(inside & (rank < k), rank, k).long()  # k: a slot to throw away
    column = torch.arange(inside.shape[2], device=inside.device).expand_as(slot)
    out = column.new_zeros(*inside.shape[:2], k + 1).scatter_(2, slot, column)[:, :, :k]
    found = inside.sum(2, keepdim=True)
    out = torch.where(torch.arange(k, device=out.device) < found, out, out[:, :, :1])
    return torch.where(found > 0, out, squares.argmin(2, keepdim=True))


def _first_on_cpu(inside: Tensor, squares: Tensor, k: int) -> Tensor:
    """As `_first`: the work is in the hits, not in all columns."""
    b, m, n = inside.shape
    flat = np.flatnonzero(inside.numpy().reshape(-1))
    row = flat // n
    found = np.bincount(row, minlength=b * m)
    begin = np.cumsum(found) - found
    if len(flat) == 0:
        return squares.argmin(2, keepdim=True).expand(b, m, k)
    slot = np.minimum(np.arange(k), np.maximum(found, 1)[:, None] - 1)  # [b * m, k]
    slot[np.arange(k) >= found[:, None]] = 0  # filled up with the first
    out = flat[np.minimum(begin[:, None] + slot, len(flat) - 1)] % n
    if not found.all():
        empty = np.flatnonzero(found == 0)
        out[empty] = squares.view(-1, n)[torch.from_numpy(empty)].argmin(1).numpy()[:, None]
    return torch.from_numpy(out).view(b, m, k)
