"""EdgeConv in training as few operations of an accelerator, forward and backward, without edges.

As in `qs3.kernels.edgeconv` an edge is z_ij = P_j + Q_i with P = W1 X, Q = R - P, R = W2 X.
With batch statistics (mean, var) of all M edges and h = gamma / sigma, the layer is

    t_i = max_j z_ij - mean  (min_j where gamma < 0),    y_i = lrelu(h t_i + beta),

and of du_i, the gradient before LeakyReLU, which reaches the edge that was taken alone,

    dbeta = sum_i du_i,     dgamma = sum_i du_i t_i / sigma,
    dz_ij = h du_i [j taken] - h / M (dbeta + (z_ij - mean) / sigma dgamma).

dQ_i sums it over the neighbours of i, for which sum_j P_j is kept of the forward pass; dP_j over
those that name j, by lists of them. So nothing of the edges' size reaches memory, and nothing is
added up in an order that changes: the result is the same in each run.

Each operation is a kernel in Triton (`triton_edge_norm`); elsewhere it takes the edges itself, and
so says what the kernel computes. All are about `pivot`, a mean of R, which is near that of z,
lest squares of deviations from it cancel.
"""

# No `from __future__ import annotations`: torch reads the operations' annotations, and where shapes
# are checked (`make test-all`) it would look their words up in another module.
from typing import Any, no_type_check

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from qs3.kernels.device import ROWS, implementation, lists_of, triton_kernels

MOST_NEIGHBOURS = 256  # which was taken is kept in a byte
_SHARE = 16

_op = torch.library.custom_op
_TRITON = "triton_edge_norm"


@_op("qs3::edge_extremes", mutates_args=())
def edge_extremes(
    pr: Tensor, index: Tensor, gamma: Tensor, pivot: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """What the layer needs of its edges.

    Of P and R [r, 2 d], rows of each point's neighbours [r, k], gamma and pivot [d].

    Returns:
        best: the greatest z of each point less pivot, the least where gamma < 0, [r, d].
        taken: which neighbour has it, uint8 [r, d], the first such.
        sums: of P over the neighbours, [r, d].
        own: Q - pivot, [r, d].
        parts: sums over some edges of z - pivot and of its square, [2, parts, d].
    """
    if kernels := triton_kernels(_TRITON, pr):
        return kernels.edge_extremes(pr, index, gamma, pivot)
    p, r = pr.chunk(2, dim=1)
    members, own = p[index], r - p - pivot  # [r, k, d], [r, d]
    sign = torch.where(gamma < 0, -1.0, 1.0).to(pr)
    taken = (members * sign).argmax(1, keepdim=True)
    z = members + own[:, None]
    parts = torch.stack([z.sum(1), z.square().sum(1)])
    return z.gather(1, taken)[:, 0], taken[:, 0].to(torch.uint8), members.sum(1), own, parts


@no_type_check
def _room_for_extremes(pr, index, gamma, pivot):
    rows, d = len(pr), len(gamma)
    best, sums, own = (pr.new_empty(rows, d) for _ in range(3))
    taken = pr.new_empty(rows, d, dtype=torch.uint8)
    return best, taken, sums, own, pr.new_empty(2, -(-rows // ROWS), d)


edge_extremes.register_fake(_room_for_extremes)


@_op("qs3::edge_output", mutates_args=())
def edge_output(
    best: Tensor,
    sums: Tensor,
    pivot: Tensor,
    gamma: Tensor,
    beta: Tensor,
    edges: int,
    eps: float,
    negative_slope: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """From `best` and the sums [2, d] of its parts: the layer's output.

    Returns:
        y, t: [r, d] each.
        constants: [5, d]: mean, var, 1 / sigma, h, and mean - pivot.
    """
    if kernels := triton_kernels(_TRITON, best):
        return kernels.edge_output(best, sums, pivot, gamma, beta, edges, eps, negative_slope)
    off, square = sums / edges
    var = (square - off.square()).clamp_min(0)
    rstd = torch.rsqrt(var + eps)
    h, t = gamma * rstd, best - off
    y = F.leaky_relu(h * t + beta, negative_slope)
    return y, t, torch.stack([pivot + off, var, rstd, h, off])


edge_output.register_fake(
    lambda best, sums, pivot, gamma, *_: (
        torch.empty_like(best),
        torch.empty_like(best),
        best.new_empty(5, len(gamma)),
    )
)


@_op("qs3::edge_output_gradient", mutates_args=())
def edge_output_gradient(
    grad: Tensor, y: Tensor, t: Tensor, constants: Tensor, negative_slope: float
) -> tuple[Tensor, Tensor]:
    """From the gradient of y [r, d]: du, that before LeakyReLU, and parts of dbeta and dgamma.

    The parts are sums over some points, [2, parts, d].
    """
    if kernels := triton_kernels(_TRITON, y):
        return kernels.edge_output_gradient(grad, y, t, constants, negative_slope)
    du = torch.where(y > 0, grad, negative_slope * grad)
    return du, torch.stack([du, du * t * constants[2]])


edge_output_gradient.register_fake(
    lambda grad, y, *_: (torch.empty_like(y), y.new_empty(2, -(-len(y) // ROWS), y.shape[1]))
)


@_op("qs3::edge_gradient", mutates_args=())
def edge_gradient(
    pr: Tensor,
    own: Tensor,
    du: Tensor,
    taken: Tensor,
    sums: Tensor,
    first: Tensor,
    order: Tensor,
    constants: Tensor,
    of_norm: Tensor,
) -> Tensor:
    """The gradient of `pr` [r, 2 d], from what the other operations gave.

    `order` int64 [r k] has edges (i k + j) in the order of the points that they lead to, `first`
    [r + 1] where those of each point begin; `of_norm` [2, d] is dbeta and dgamma.
    """
    if kernels := triton_kernels(_TRITON, pr):
        return kernels.edge_gradient(pr, own, du, taken, sums, first, order, constants, of_norm)
    rows, d = du.shape
    k = len(order) // rows
    p = pr[:, :d]
    _, _, rstd, h, off = constants
    leads = torch.arange(rows, device=pr.device).repeat_interleave(first.diff())
    index = torch.empty_like(order).scatter_(0, order, leads).view(rows, k)
    z = p[index] + (own - off)[:, None]  # [r, k, d], less mean
    chosen = torch.arange(k, device=pr.device)[:, None] == taken[:, None]
    dz = h * du[:, None] * chosen - h / len(order) * (of_norm[0] + z * rstd * of_norm[1])
    dp = torch.zeros_like(du).index_add_(0, index.flatten(), dz.flatten(0, 1))
    dq = dz.sum(1)
    return torch.cat([dp - dq, dq], dim=1)


edge_gradient.register_fake(lambda pr, *_: torch.empty_like(pr))


class _EdgeNorm(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        pr: Tensor,
        index: Tensor,
        gamma: Tensor,
        beta: Tensor,
        eps: float,
        slope: float,
    ) -> tuple[Tensor, Tensor, Tensor]:
        at = implementation(__name__, _TRITON, pr)
        # Of some points, which decide nothing but the rounding: of a share s of all their mean is
        # off by at most sqrt((1 - s) / s) deviations.
        pivot = pr[: -(-len(pr) // _SHARE), len(gamma) :].mean(0)
        best, taken, sums, own, parts = at.edge_extremes(pr, index, gamma, pivot)
        y, t, constants = at.edge_output(
            best, parts.sum(1), pivot, gamma, beta, index.numel(), eps, slope
        )
        ctx.save_for_backward(pr, index, taken, sums, own, t, y, constants)
        ctx.slope = slope
        mean, var = constants[0], constants[1]
        ctx.mark_non_differentiable(mean, var)
        return y, mean, var

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        pr, index, taken, sums, own, t, y, constants = ctx.saved_tensors
        at = implementation(__name__, _TRITON, pr)
        du, parts = at.edge_output_gradient(grad.contiguous(), y, t, constants, ctx.slope)
        of_norm = parts.sum(1)
        first, order = lists_of(index.flatten(), len(pr))
        dpr = at.edge_gradient(pr, own, du, taken, sums, first, order, constants, of_norm)
        return dpr, None, of_norm[1], of_norm[0], None, None


def edge_norm(
    pr: Float[Tensor, "r c"],
    index: Int[Tensor, "r k"],
    gamma: Float[Tensor, " d"],
    beta: Float[Tensor, " d"],
    eps: float,
    negative_slope: float,
) -> tuple[Float[Tensor, "r d"], Float[Tensor, " d"], Float[Tensor, " d"]]:
    """The layer's output, and mean and biased variance of z over all edges, without gradients.

    Of P and R of all points, and rows of each point's neighbours, at most `MOST_NEIGHBOURS`; the
    slope is at least 0.
    """
    return _EdgeNorm.apply(pr.contiguous(), index.contiguous(), gamma, beta, eps, negative_slope)


def edge_maximum(pr: Float[Tensor, "r c"], index: Int[Tensor, "r k"]) -> Float[Tensor, "r d"]:
    """The greatest z of each point, as in `edge_norm`; without a way back."""
    d = pr.shape[1] // 2
    at = implementation(__name__, _TRITON, pr)
    best = at.edge_extremes(pr, index.contiguous(), pr.new_ones(d), pr.new_zeros(d))[0]
    return best
