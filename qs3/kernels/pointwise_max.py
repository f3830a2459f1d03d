"""The maximum over the points of a linear layer, and of its norm, without the layer's output.

For the layers of 1,024 channels of PointNet, on the CPU, and of DGCNN. Norm and ReLU are monotone
in a channel, so of z = W y only the maximum over each cloud is needed, or the minimum where the
norm's weight is negative (then W comes with that sign). Mean and variance of z follow from those
of y: mean(z) = W mean(y), var(z) = diag(W cov(y) W'). Backwards

    dz = D + (dmean + 2 (z - mean) dvar) / rows,   D the gradient at the maxima,

so that dy and dW are products of the input's width, and a row for each entry of D.
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from qs3 import kernels as fast
from qs3.kernels import compiled
from qs3.kernels.device import exporting
from qs3.kernels.matmul import matmul_t
from qs3.kernels.norms import active, statistics, uses_batch

_AT_ONCE = 1 << 20  # values of z worked on at once: 4 MB in float32


def max_over_rows(x: Float[Tensor, "b n c"]) -> tuple[Float[Tensor, "b c"], Int[Tensor, "b c"]]:
    """`x.max(1)`: values and the first rows that have them, about ten times faster on the CPU.

    Pooling of an image in channels-last layout is the only maximum of torch on the CPU that is
    vectorised and returns its place. On other devices it is any row that has the value.
    """
    if not fast.on_cpu(x):
        return x.max(1)
    image = x[:, :, None].permute(0, 3, 1, 2)  # [b, c, n, 1]
    best, where = F.max_pool2d(image, (x.shape[1], 1), return_indices=True)
    return best.flatten(1), where.flatten(1)


class _MaxOverMembers(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        best, where = x.max(-2, keepdim=True)
        ctx.save_for_backward(where)
        ctx.members = x.shape[-2]
        return best.squeeze(-2)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (where,) = ctx.saved_tensors
        members = torch.arange(ctx.members, device=grad.device)[:, None]
        return grad.unsqueeze(-2) * (members == where)


def max_over_members(x: Float[Tensor, "*b k c"]) -> Float[Tensor, "*b c"]:
    """`x.max(-2)[0]`; its gradient is written, not scattered.

    For a scatter torch's deterministic algorithms sort all places on a GPU: here as many as there
    are values of the result, though no two of them are the same.
    """
    return x.max(-2)[0] if exporting() else _MaxOverMembers.apply(x)


def relu_gradient(grad: Tensor, out: Tensor) -> Tensor:
    """Gradient through relu, in the place of that of its output `out`."""
    return torch.ops.aten.threshold_backward.grad_input(grad, out, 0, grad_input=grad)


class _Largest(torch.autograd.Function):
    """[b, n, c] and W [d, c] to the maximum [b, d] of z, and its mean and biased variance [d]."""

    @staticmethod
    def forward(
        ctx: Any, y: Tensor, weight: Tensor, statistics: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        b, n, c = y.shape
        best = y.new_empty(b, len(weight))
        where = torch.empty(best.shape, dtype=torch.int64, device=y.device)
        step = max(1, _AT_ONCE // (n * len(weight)))
        rows = y.reshape(b * n, c)
        for i in range(0, b, step):
            z = matmul_t(rows[i * n : (i + step) * n], weight).view(-1, n, len(weight))
            best[i : i + step], where[i : i + step] = max_over_rows(z)
        centre = covariance = None
        mean = var = best.new_zeros(len(weight))
        if statistics:
            centre = rows.mean(0)
            covariance = torch.zeros(c, c, dtype=torch.float64, device=y.device)
            for part in (rows - centre).split(n):
                covariance += part.T @ part
            covariance /= b * n
            wide = weight.double()
            mean = weight @ centre
            var = ((wide @ covariance) * wide).sum(1).clamp_min(0).to(y.dtype)
        ctx.save_for_backward(rows, weight, where, centre, covariance)
        return best, mean, var

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, dbest: Tensor, dmean: Tensor, dvar: Tensor) -> tuple[Tensor | None, ...]:
        rows, weight, where, centre, covariance = ctx.saved_tensors
        b, c = len(where), rows.shape[1]
        n = len(rows) // b
        if centre is not None:
            slope = 2 * dvar / len(rows)
            product = weight.T @ (weight * slope[:, None])  # [c, c], symmetric
            dy = matmul_t(rows, product, (dmean / len(rows)) @ weight - centre @ product)
            dweight = 2 * dvar[:, None] * (weight @ covariance.to(weight.dtype))
            dweight += torch.outer(dmean, centre)
        else:
            dy, dweight = torch.zeros_like(rows), torch.zeros_like(weight)
        found = compiled.linear_max_backward(rows.view(b, n, c), weight, dbest, where)
        return dy.view(b, n, c).add_(found[0]), dweight.add_(found[1]), None


def normed_maximum(
    y: Float[Tensor, "b n c"], layer: nn.Linear, norm: nn.Module
) -> Float[Tensor, "b d"]:
    """`norm(layer(y))`, its maximum over the points; `norm` is a batch norm (of the domain).

    The gradient of a maximum goes to one of the points that have it.
    """
    plain = active(norm)
    gamma = plain.weight
    sign = torch.where(gamma < 0, -1.0, 1.0).to(gamma.dtype)
    best, mean, var = _Largest.apply(y, layer.weight * sign[:, None], uses_batch(plain))
    best, mean = best * sign, mean * sign
    if layer.bias is not None:
        best, mean = best + layer.bias, mean + layer.bias
    mean, var = statistics(plain, mean, var, y.shape[0] * y.shape[1])
    return (best - mean) * (gamma * torch.rsqrt(var + plain.eps)) + plain.bias
