"""Farthest points as one operation: of an accelerator, and of a graph.

Step by step they are nine kernels a point. On a GPU they are one, written in Triton, which comes
with torch's builds for it; elsewhere the operation takes the steps itself.
"""

from __future__ import annotations

from typing import Any, no_type_check

import torch
from torch import Tensor

from qs3.geometry.device import takes_triton

_LARGEST = 1 << 14  # points that a thread block can hold


@torch.library.custom_op("qs3::farthest_points", mutates_args=())
def farthest_points(x: Tensor, n: int, start: Tensor) -> Tensor:
    """Order in which farthest point sampling takes points.

    Args:
        x: [b, N, 3] float32, about each cloud's mean.
        n: how many, at most N.
        start: [b] int64, the first ones.

    Returns:
        [b, n] int64.
    """
    if x.is_cuda and x.shape[1] <= _LARGEST and takes_triton(x):
        from qs3.geometry import triton_farthest_points

        return triton_farthest_points.farthest_points(x, n, start)
    out = torch.empty(len(x), n, dtype=torch.int64, device=x.device)
    state = _begin(x, start)
    for i in range(n):
        state, last = _step(x, state)
        out[:, i] = last[:, 0]
    return out


@farthest_points.register_fake
def _(x: Tensor, n: int, start: Tensor) -> Tensor:
    return x.new_empty(len(x), n, dtype=torch.int64)


def farthest_points_by_scan(x: Tensor, n: int, start: Tensor) -> Tensor:
    """As `farthest_points`, by a loop that a graph can hold."""
    from torch._higher_order_ops.scan import scan

    @no_type_check  # torch's compiler goes through it, and cannot through checks of shapes
    def step(state, _):
        return _step(x, state)

    _, taken = scan(step, _begin(x, start), torch.arange(n, device=x.device))
    return taken[:, :, 0].T  # [b, n]


def _begin(x: Tensor, start: Tensor) -> Any:
    """Squared distances to the points taken so far [b, N], and the next one [b, 1]."""
    return torch.full_like(x[:, :, 0], torch.inf), start[:, None].clone()


@no_type_check
def _step(x, state):
    """The state after one more point, and that point [b, 1]."""
    nearest, last = state
    taken = x.gather(1, last[:, :, None].expand(-1, -1, 3))
    distance = (x - taken).square().sum(-1)
    nearest = torch.minimum(nearest, distance).scatter(1, last, -1.0)  # never again
    return (nearest, nearest.argmax(1, keepdim=True)), last.clone()
