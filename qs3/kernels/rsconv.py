"""Relation-shape convolution on unique pairs (`qs3.models.rscnn.RSConv` has it as published).

Written out, h_ij, w_ij = M(h_ij), p_ij = w_ij * x_ij and what comes between them are a dozen
tensors [B, M, K, C]. Here, with the same sums:

- Slots that repeat a ball's first member are computed once and weigh as much as there are of them
  in statistics. Balls are put together by size, so that there are hardly any other copies.
- h_ij has few distinct numbers, so M's first layer is linear in u = (|d|, s, d, 1), and mean and
  variance of what it gives follow from those of u: mean = A mean(u), var = diag(A cov(u) A'). With
  that norm folded into A only relu(A u) is made.
- norm and ReLU are monotone in a channel, so the maximum needs the largest p only, or the smallest
  where the norm's weight is negative. p is made some balls at a time, counted and forgotten; the
  backward pass makes it again. The gradient of slot j is that of the maximum, where it is, and

      weight_j (dmean + 2 (p_j - mean) dvar) / slots.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from qs3.kernels.norms import active, statistics, uses_batch
from qs3.kernels.pointwise_max import max_over_rows, relu_gradient

_AT_ONCE = 1 << 18  # values of p worked on at once: 1 MB in float32
_STEP = 4  # sizes of balls are rounded up to multiples of it


class Balls(NamedTuple):
    """Balls of nearly one size."""

    which: Tensor  # [g] int64, rows among all balls
    members: Tensor  # [g, k] int64, their rows among the points of all clouds
    u: Tensor  # [g, k, 8] |d|, s (3), d (3), 1 of each member, d from the centre to it
    weight: Tensor  # [g, k] slots that hold this member; 0 for a copy that fills up the row


class Relations(NamedTuple):
    """All balls of a batch."""

    balls: tuple[Balls, ...]  # by size; each ball is in one of them
    number: int  # of balls
    slots: int  # that they have as published, copies included

    def moments(self) -> tuple[Tensor, Tensor]:
        """Mean [8] and covariance [8, 8] of u over all slots, float64."""
        rows = [b.u.flatten(0, 1).double() for b in self.balls]
        weights = [b.weight.flatten().double() for b in self.balls]
        total = torch.stack([w @ u for w, u in zip(weights, rows, strict=True)]).sum(0)
        mean = total / self.slots
        rows = [u - mean for u in rows]
        parts = [(u * w[:, None]).T @ u for w, u in zip(weights, rows, strict=True)]
        return mean, torch.stack(parts).sum(0) / self.slots


@torch.no_grad()
def relations(points: Tensor, centres: Tensor, index: Tensor, relation: str) -> Relations:
    """Put balls together by size and describe their members.

    Of points [B, N, 3], centres [B, M, 3], and index [B, M, K] int64, a ball's distinct members
    first, then copies of the first. s is by `relation` "released" d of the first member, by "paper"
    the centre.
    """
    b, n, _ = points.shape
    m, k = index.shape[1:]
    first = torch.arange(b, device=points.device)[:, None, None] * n
    flat, xyz = (index + first).view(b * m, k), points.reshape(-1, 3)
    centres = centres.reshape(-1, 3)
    found = 1 + (flat[:, 1:] != flat[:, :1]).sum(1)  # [b * m]
    sizes = (-(-found // _STEP) * _STEP).clamp_max(k)
    balls = []
    for size in sizes.unique().tolist():
        which = (sizes == size).nonzero()[:, 0]
        members = flat[which, :size]
        d = xyz[members] - centres[which, None]  # [g, size, 3]
        s = centres[which, None] if relation == "paper" else d[:, :1]
        ones = torch.ones_like(d[:, :, :1])
        u = torch.cat([d.norm(dim=2, keepdim=True), s.expand_as(d), d, ones], dim=2)
        slot = torch.arange(size, device=points.device)
        weight = (slot < found[which, None]).to(u)
        weight[:, 0] += k - found[which]
        balls.append(Balls(which, members, u, weight))
    return Relations(tuple(balls), b * m, b * m * k)


class _LargestProduct(torch.autograd.Function):
    """Maximum over each ball of p = (relu(u A') M' + c) * x, and mean and variance of p.

    x is relu(u R') if `raising` R is given, otherwise (d, features).
    """

    @staticmethod
    def forward(
        ctx: Any,
        relations: Relations,
        features: Tensor | None,
        mapping: Tensor,
        raising: Tensor | None,
        weight: Tensor,
        bias: Tensor,
        statistics: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        best = mapping.new_empty(relations.number, len(weight))
        where = torch.empty(best.shape, dtype=torch.int64, device=best.device)
        moments = _Moments(weight)
        for part in _parts(relations, len(weight)):
            _, _, _, p = _products(part, features, mapping, raising, weight, bias)
            best[part.which], where[part.which] = max_over_rows(p)
            if statistics:
                moments.add(p, part.weight)
        mean, var = moments.result(weight.dtype)
        ctx.save_for_backward(features, mapping, raising, weight, bias, where, mean)
        ctx.relations, ctx.statistics = relations, statistics
        return best, mean, var

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, dbest: Tensor, dmean: Tensor, dvar: Tensor) -> tuple[Tensor | None, ...]:
        features, mapping, raising, weight, bias, where, mean = ctx.saved_tensors
        dfeatures = None if features is None else torch.zeros_like(features)
        dmapping, dweight = torch.zeros_like(mapping), torch.zeros_like(weight)
        draising = None if raising is None else torch.zeros_like(raising)
        dbias = torch.zeros_like(bias)
        slope = 2 * dvar / ctx.relations.slots
        offset = dmean / ctx.relations.slots - slope * mean
        for part in _parts(ctx.relations, len(weight)):
            a, w, x, p = _products(part, features, mapping, raising, weight, bias)
            u = part.u.flatten(0, 1)
            if ctx.statistics:
                dp = torch.addcmul(offset, p, slope, out=p).mul_(part.weight[:, :, None])
            else:
                dp = p.zero_()
            dp.scatter_add_(1, where[part.which, None], dbest[part.which, None])
            dp = dp.flatten(0, 1)
            dx = w.mul_(dp)
            if draising is not None:
                draising.addmm_(relu_gradient(dx, x).T, u)
            elif dfeatures is not None:
                dfeatures.index_add_(0, part.members.flatten(), dx[:, 3:].contiguous())
            dw = dp.mul_(x)
            dweight.addmm_(dw.T, a)
            dbias += dw.sum(0)
            dmapping.addmm_(relu_gradient(dw @ weight, a).T, u)
        return None, dfeatures, dmapping, draising, dweight, dbias, None


def _products(
    part: Balls,
    features: Tensor | None,
    mapping: Tensor,
    raising: Tensor | None,
    weight: Tensor,
    bias: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """relu(u A'), w, x of each member [r, c], and p [g, k, c]."""
    u = part.u.flatten(0, 1)
    a = (u @ mapping.T).relu_()
    w = torch.addmm(bias, a, weight.T)
    if raising is not None:
        x = (u @ raising.T).relu_()
    else:
        assert features is not None
        x = torch.cat([u[:, 4:7], features.index_select(0, part.members.flatten())], dim=1)
    return a, w, x, (w * x).view(*part.members.shape, -1)


def _parts(relations: Relations, channels: int) -> Iterator[Balls]:
    """Some balls at a time."""
    for balls in relations.balls:
        step = max(1, _AT_ONCE // (balls.members.shape[1] * channels))
        for i in range(0, len(balls.which), step):
            yield Balls(*(values[i : i + step] for values in balls))


class _Moments:
    """Mean and biased variance of weighted rows that come in parts (Chan et al. 1979), float64."""

    def __init__(self, like: Tensor) -> None:
        self.total = 0.0
        self.mean = torch.zeros(len(like), dtype=torch.float64, device=like.device)
        self.squares = torch.zeros_like(self.mean)

    def add(self, rows: Tensor, weight: Tensor) -> None:
        """Some more rows [g, k, c] with their weights [g, k]."""
        rows, weight = rows.flatten(0, 1), weight.flatten()
        total = float(weight.sum())
        mean = weight @ rows / total
        squares = weight @ (rows - mean).square_()
        step = mean.double() - self.mean
        self.squares += squares + step.square() * (self.total * total / (self.total + total))
        self.total += total
        self.mean += step * (total / self.total)

    def result(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        return self.mean.to(dtype), (self.squares / max(self.total, 1)).to(dtype)


def rs_conv(
    relations: Relations,
    features: Tensor | None,
    relation: str,
    *,
    mapping: tuple[nn.Linear, nn.Module],
    weighing: nn.Linear,
    raising: tuple[nn.Linear, nn.Module] | None,
    norm: nn.Module,
) -> Tensor:
    """max_j relu(norm(M(h_ij) * x_ij)) of each ball: [count, C].

    M is `weighing` of relu of `mapping`, a layer and its norm; x is relu of `raising`, likewise, or
    (d, features) if None, with features [P, C'] of the points of all clouds. `norm` is that of the
    products. With instance norms give one cloud at a time.
    """
    moments = relations.moments()
    slots = relations.slots
    first = _fold(_in_u(mapping[0], relation), mapping[1], moments, slots)
    raised = None
    if raising is not None:
        weight, bias = raising[0].weight, raising[0].bias
        none = weight.new_zeros(len(weight), 4)
        raised = torch.cat([none, weight, bias[:, None]], dim=1)  # [16, 8]
        raised = _fold(raised, raising[1], moments, slots)
    gamma = active(norm).weight
    sign = torch.where(gamma < 0, -1.0, 1.0).to(gamma.dtype)
    best, mean, var = _LargestProduct.apply(
        relations, features, first, raised,
        weighing.weight * sign[:, None], weighing.bias * sign, uses_batch(norm),
    )  # fmt: skip
    h, shift = _affine(norm, sign * mean, var, slots)
    return (best * (sign * h) + shift).relu()


def _in_u(layer: nn.Linear, relation: str) -> Tensor:
    """M's first layer on u: h = (|d|, xi, xj, xj - xi) with what xi and xj are in `relation`."""
    length, xi, xj, d = layer.weight.split([1, 3, 3, 3], dim=1)
    s = xi + xj if relation == "paper" else xi  # xj = xi + d there, d elsewhere
    return torch.cat([length, s, xj + d, layer.bias[:, None]], dim=1)


def _fold(layer: Tensor, norm: nn.Module, moments: tuple[Tensor, Tensor], slots: int) -> Tensor:
    """The norm of a linear map [c, 8] of u as one map of u."""
    mean, covariance = moments
    wide = layer.double()
    var = ((wide @ covariance) * wide).sum(1).clamp_min(0)
    h, shift = _affine(norm, wide @ mean, var, slots)
    return torch.cat([h[:, None] * layer[:, :7], (h * layer[:, 7] + shift)[:, None]], dim=1)


def _affine(norm: nn.Module, mean: Tensor, var: Tensor, slots: int) -> tuple[Tensor, Tensor]:
    """Scale and shift of a norm, of these statistics or of the running ones, which it updates."""
    plain = active(norm)
    mean, var = statistics(plain, mean, var, slots)
    h = plain.weight * torch.rsqrt(var + plain.eps)
    return h.to(plain.weight.dtype), (plain.bias - h * mean).to(plain.weight.dtype)
