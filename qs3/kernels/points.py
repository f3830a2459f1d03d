"""Farthest points, and the k smallest values of rows, as one operation each of an accelerator.

Step by step farthest points are nine kernels a point. torch's topk orders a row by radix passes
over it, several kernels of them; for the few neighbours of a point it is faster to hold the row in
registers and to take its least value k times. On a GPU each is one kernel (`triton_points`), in
Triton, which comes with torch's builds for it; elsewhere the operations take the steps themselves.
"""

from typing import Any, no_type_check

import torch
from torch import Tensor

from qs3.kernels.device import triton_kernels

_MOST_POINTS = 1 << 14  # of a cloud that a thread block can hold
_MOST_VALUES = 1 << 12  # of a row that a warp or a few can hold


@torch.library.custom_op("qs3::farthest_points", mutates_args=())
def farthest_points(x: Tensor, n: int, start: Tensor) -> Tensor:
    """Order [b, n] in which farthest point sampling takes n of N points, from start [b] on.

    x: [b, N, 3] float32, about each cloud's mean.
    """
    if x.shape[1] <= _MOST_POINTS and (kernels := triton_kernels("triton_points", x)):
        return kernels.farthest_points(x, n, start)
    out = torch.empty(len(x), n, dtype=torch.int64, device=x.device)
    state = _begin(x, start)
    for i in range(n):
        state, last = _step(x, state)
        out[:, i] = last[:, 0]
    return out


farthest_points.register_fake(lambda x, n, start: x.new_empty(len(x), n, dtype=torch.int64))


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


@torch.library.custom_op("qs3::smallest_of_rows", mutates_args=())
def smallest_sums(values: Tensor, more: Tensor, k: int) -> Tensor:
    """Columns [b, r, k] of the k smallest of values [b, r, n] after `more` [b, n] is added.

    Smallest first; of equal values any comes first, NaN last. `compiled` has the CPU's.
    """
    if values.shape[-1] <= _MOST_VALUES and (kernels := triton_kernels("triton_points", values)):
        return kernels.smallest_sums(values, more, k)
    return (values + more[:, None]).topk(k, largest=False)[1]


smallest_sums.register_fake(
    lambda values, more, k: values.new_empty(*values.shape[:2], k, dtype=torch.int64)
)
