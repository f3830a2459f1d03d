"""Maximum and mean over points of a linear layer, on the CPU and as few operations elsewhere.

Of z = W x one point of each cloud has a
channel's maximum, so D, the gradient of z at the maxima, has one entry a cloud and channel:

    dx_r = sum over the channels whose maximum r has, of D W_channel,
    dW_channel = sum over the clouds, of D x_(the point that has it),

where products with the gradient of all z would be of the layer's size, twice. Each operation is a
kernel in Triton (`triton_linear_max`), which adds up in an order that never changes; elsewhere it
takes torch's operations, and so says what the kernel computes.
"""

# No `from __future__ import annotations`: torch reads the operations' annotations, and where shapes
# are checked (`make test-all`) it would look their words up in another module.
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from qs3 import kernels as fast
from qs3.kernels import compiled
from qs3.kernels.device import implementation, lists_of, triton_kernels
from qs3.kernels.matmul import matmul_t
from qs3.kernels.pointwise_max import max_over_rows

_op = torch.library.custom_op
_TRITON = "triton_linear_max"
_AT_ONCE = 1 << 22  # values of z at once on the CPU: 16 MB in float32


@_op("qs3::linear_max_gradient", mutates_args=())
def points_gradient(
    grad: Tensor, weight: Tensor, beside: Tensor, first: Tensor, order: Tensor
) -> Tensor:
    """The gradient of x [b, n, c].

    Args:
        grad: D at its beginning, [b, at least d].
        weight: [d, c].
        beside: [b, c], of which each of a cloud's n points has its share.
        first, order: channels in the order of the points that have their maxima, int64 [b, d], and
            where those of a point begin, [b, n + 1].
    """
    if kernels := triton_kernels(_TRITON, weight):
        return kernels.points_gradient(grad, weight, beside, first, order)
    (b, d), n = order.shape, first.shape[1] - 1
    rows = torch.arange(b * n, device=grad.device)
    rows = rows.repeat_interleave(first.diff().flatten(), output_size=b * d)
    entries = grad.gather(1, order)[:, :, None] * weight[order]  # [b, d, c]
    dx = (beside / n).repeat_interleave(n, dim=0)
    return dx.index_add_(0, rows, entries.flatten(0, 1)).view(b, n, -1)


points_gradient.register_fake(
    lambda grad, weight, beside, first, order: weight.new_empty(
        len(first), first.shape[1] - 1, weight.shape[1]
    )
)


@_op("qs3::linear_max_weight_gradient", mutates_args=())
def weight_gradient(grad: Tensor, x: Tensor, where: Tensor, base: Tensor) -> Tensor:
    """The gradient of W, added to `base` [d, c]; `where` [b, d] are the points of the maxima."""
    if kernels := triton_kernels(_TRITON, x):
        return kernels.weight_gradient(grad, x, where, base)
    rows = x.gather(1, where[:, :, None].expand(-1, -1, x.shape[2]))  # [b, d, c]
    return base + (grad[:, : len(base), None] * rows).sum(0)


weight_gradient.register_fake(lambda grad, x, where, base: torch.empty_like(base))


class _Pooled(torch.autograd.Function):
    """Its gradient needs no [B, N, D]: the maximum's is one row of x and of weight per channel."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        if fast.on_cpu(x):
            (b, n, _), d = x.shape, len(weight)
            most, where = x.new_empty(b, d), torch.empty(b, d, dtype=torch.int64)
            step = max(1, _AT_ONCE // (n * d))
            for i in range(0, b, step):
                y = matmul_t(x[i : i + step], weight)  # [step, n, d]
                most[i : i + step], where[i : i + step] = max_over_rows(y)
        else:
            most, where = (x @ weight.T).max(1)
        centre = x.mean(1)  # [b, c]
        ctx.save_for_backward(x, weight, where, centre)
        return torch.cat([most, centre @ weight.T], dim=1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        x, weight, where, centre = ctx.saved_tensors
        grad = grad.to(x.dtype).contiguous()
        most, mean = grad.chunk(2, dim=1)  # [b, d] each
        if fast.on_cpu(x):
            found = compiled.linear_max_backward(x, weight, most, where)
            dx = (mean @ weight / x.shape[1])[:, None].expand_as(x).contiguous()
            return dx.add_(found[0]), (mean.T @ centre).add_(found[1])
        first, order = lists_of(where, x.shape[1])
        at = implementation(__name__, _TRITON, x)
        dx = at.points_gradient(grad, weight, mean @ weight, first, order)
        return dx, at.weight_gradient(grad, x, where, mean.T @ centre)


def pooled_linear(
    x: Float[Tensor, "b n c"], weight: Float[Tensor, "d c"]
) -> Float[Tensor, "b 2*d"]:
    """Maximum and mean over the points of a linear map without bias."""
    return _Pooled.apply(x.contiguous(), weight.contiguous())
