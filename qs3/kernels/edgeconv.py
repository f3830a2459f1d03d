"""EdgeConv without its edges (`qs3.models.dgcnn.EdgeConv` has it as published).

With the weight split into W = [W1 | W2] an edge (x_j - x_i, x_i) becomes

    z_ij = W1 x_j + (W2 - W1) x_i = P_j + Q_i,

and, as norm (scale h = gamma / sigma, which may be negative) and LeakyReLU act on each
channel alone and the latter increases,

    max_j lrelu(h z_ij + shift) = lrelu(max_j (h P_j) + h Q_i + shift).

So k edges a point are never built. The statistics over all edges are exact too, from second
moments of the *inputs*: with A the adjacency (A_ij = 1 if j is a neighbour of i), d its column sums
(in-degrees) and E = W2 - W1,

    sum_ij z_ij   = W1 X'd + k E X'1
    sum_ij z_ij^2 = diag(W1 X' diag(d) X W1' + 2 E X'(A X) W1' + k E X'X E').

That is for the CPU, where what goes along the edges, A and the maximum, is compiled
(`qs3.kernels.compiled`). To an accelerator these are 164 kernels a layer, forward and backward,
each started by itself; there `edge_norm` takes the statistics on its way over the edges, and where
it is not at hand z_ij is written out for them, in 30.
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from qs3 import kernels as fast
from qs3.kernels import compiled
from qs3.kernels.device import exporting, takes_triton
from qs3.kernels.edge_norm import MOST_NEIGHBOURS, edge_maximum, edge_norm
from qs3.kernels.matmul import linear
from qs3.kernels.norms import active, normed, running, track, uses_batch
from qs3.kernels.pointwise_max import max_over_members


class _NeighbourMax(torch.autograd.Function):
    """max_j x[index[i, j]] per channel; the gradient goes to the first j that has it."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, index: Tensor) -> Tensor:
        ctx.points = x.shape[0]
        out, where = compiled.neighbour_max(x, index)
        ctx.save_for_backward(where)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (where,) = ctx.saved_tensors
        return compiled.neighbour_max_backward(grad, where, ctx.points), None


class _Moments(torch.autograd.Function):
    """What the statistics of all edges need of x [g, r, c]: X'd, X'1, X' diag(d) X, X'A X, X'X.

    Written out, as autograd would take half as many products again and keep [g, r, c] of each.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, index: Tensor) -> tuple[Tensor, ...]:
        degree = torch.bincount(index.flatten(), minlength=index.shape[0])
        degree = degree.to(x.dtype).view(*x.shape[:2], 1)
        weighted = degree * x
        sums = F.embedding_bag(index, x.flatten(0, 1), mode="sum").view_as(x)  # A X
        xt = x.transpose(1, 2)
        ctx.save_for_backward(x, index, degree, sums)
        return weighted.sum(1), x.sum(1), xt @ weighted, xt @ sums, xt @ x

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        x, index, degree, sums = ctx.saved_tensors
        d_first, d_second, d_xdx, d_xax, d_xx = grads
        dx = torch.baddbmm(d_first[:, None], x, d_xdx + d_xdx.transpose(1, 2)).mul_(degree)
        dx.add_(d_second[:, None])
        dx.baddbmm_(x, d_xx + d_xx.transpose(1, 2))
        dx.baddbmm_(sums, d_xax.transpose(1, 2))
        upstream = compiled.add_to_neighbours((x @ d_xax).flatten(0, 1), index)
        return dx.add_(upstream.view_as(dx)), None


def neighbour_max(x: Float[Tensor, "p c"], index: Int[Tensor, "q k"]) -> Float[Tensor, "q c"]:
    """Maximum over each row's neighbours, per channel."""
    if exporting() or not fast.on_cpu(x):
        return max_over_members(x.index_select(0, index.flatten()).view(*index.shape, x.shape[1]))
    return _NeighbourMax.apply(x, index)


def _product(x: Tensor, weight: Tensor) -> Tensor:
    """[g, r, c] and [g, d, c] to [g, r, d]."""
    if len(x) == 1:
        return linear(x[0], weight[0])[None]
    return x @ weight.transpose(1, 2)


def edge_conv(
    x: Float[Tensor, "b n c"],
    index: Int[Tensor, "b n k"],
    weight: Float[Tensor, "d 2*c"],
    norm: nn.Module,
    negative_slope: float,
) -> Float[Tensor, "b n d"]:
    """The layer's output; traceable unless the norm (of `make_norm`) `uses_batch`.

    x is in the dtype of `weight`, which is [W1 | W2]. On the CPU the norm is `track`ed, not called.
    """
    b, n, c = x.shape
    k = index.shape[2]
    first = torch.arange(b, device=x.device)[:, None, None] * n
    flat = (index + first).view(b * n, k)  # rows of all clouds put together
    norm = active(norm)
    if uses_batch(norm) and _takes_edge_norm(x, norm, k, negative_slope):
        both = weight.view(-1, 2, c).transpose(0, 1).reshape(-1, c)  # W1 above W2
        pr = x.reshape(b * n, c) @ both.T
        y, mean, var = edge_norm(pr, flat, norm.weight, norm.bias, norm.eps, negative_slope)
        track(norm, mean, var, b * n * k)
        return y.view(b, n, -1)
    w1, w2 = weight.split(c, dim=1)  # [d, c] each
    e = w2 - w1
    if uses_batch(norm) and not fast.on_cpu(x):
        points = x.reshape(b * n, c)
        p, q = points @ w1.T, points @ e.T
        z = p.index_select(0, flat.flatten()).view(b, n, k, -1) + q.view(b, n, 1, -1)
        return F.leaky_relu(max_over_members(normed(norm, z)), negative_slope)
    rows = x.reshape(b if isinstance(norm, nn.InstanceNorm1d) else 1, -1, c)  # [g, r, c]
    if uses_batch(norm):
        # about the mean, lest E[z^2] - E[z]^2 cancel; z only changes by W2 centre
        centre = rows.detach().mean(1, keepdim=True)
        rows = rows - centre
        mean, var = _statistics(rows, flat, w1, e)  # [g, d]
        track(norm, mean[0] + centre[0, 0] @ w2.T, var[0], b * n * k)
    else:
        mean, var = (held[None] for held in running(norm))
    h = norm.weight * torch.rsqrt(var + norm.eps)
    shift = norm.bias - h * mean
    if not uses_batch(norm) and _takes_maximum(x, weight, h, k):
        both = torch.cat([h[0, :, None] * w1, h[0, :, None] * w2])  # P, and R = P + Q
        pr = torch.addmm(F.pad(shift[0], (len(w1), 0)), x.reshape(b * n, c), both.T)
        return F.leaky_relu(edge_maximum(pr, flat), negative_slope).view(b, n, -1)
    p = _product(rows, h[:, :, None] * w1)  # [g, r, d]
    q = _product(rows, h[:, :, None] * e) + shift[:, None]
    best = neighbour_max(p.flatten(0, 1), flat).view_as(q)
    return F.leaky_relu(best + q, negative_slope).view(b, n, -1)


def _takes_edge_norm(x: Tensor, norm: nn.Module, k: int, negative_slope: float) -> bool:
    batch_norm = isinstance(norm, nn.BatchNorm1d) and norm.affine
    return takes_triton(x) and batch_norm and k <= MOST_NEIGHBOURS and negative_slope >= 0


def _takes_maximum(x: Tensor, weight: Tensor, h: Tensor, k: int) -> bool:
    """Whether no way back is asked for, which the kernel has not."""
    trained = any(t.requires_grad for t in (x, weight, h)) and torch.is_grad_enabled()
    return takes_triton(x) and k <= MOST_NEIGHBOURS and not trained and not exporting()


def _statistics(x: Tensor, flat: Tensor, w1: Tensor, e: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and biased variance of z over the edges of each group: [g, d] each."""
    k = flat.shape[1]
    edges = x.shape[1] * k
    xd, x1, xdx, xax, xx = _Moments.apply(x, flat)
    mean = (xd @ w1.T + k * (x1 @ e.T)) / edges
    square = ((w1 @ xdx + 2 * (e @ xax)) * w1).sum(2) + k * ((e @ xx) * e).sum(2)
    return mean, (square / edges - mean.square()).clamp_min(0)
