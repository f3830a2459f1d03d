"""Shared MLPs over groups of neighbours without the tensors that they are published with.

`qs3.models.pointnet2.GroupedMLP` has them as published: a [B, M, K, C] tensor or four for each
layer. Here, with the same sums:

- The first convolution is linear in (x_j - c_i, f_j), so z_ij = Wx (x_j - c_i) + P_j with one
  product a point for the features. Members gather P, and gather again where z is needed once more.
  (Coordinates could be split likewise, Wx x_j - Wx c_i, but small differences would lose digits.)
- Of the layers between only the convolution's output z is kept; y = relu(z h + s) is made again
  from it, some groups at a time, where it is read.
- The last layer's activation increases with h z where h = gamma / sigma, so only the maximum of
  sign(gamma) z is needed and its z is never kept. Its statistics follow from those of its input:
  mean(z) = W mean(y), var(z) = diag(W cov(y) W'). In the backward pass

      dz = D + a + b z,   D the gradient at the maxima, one member a group and channel,

  so dW = D'y + a sum(y) + diag(b) W (Y'Y) and dy = D W + a W + y (W' diag(b) W): products of the
  input's width instead of the output's, and some rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from qs3.kernels.matmul import matmul_t, t_matmul
from qs3.kernels.norms import active, track, uses_batch
from qs3.kernels.pointwise_max import max_over_rows

_AT_ONCE = 1 << 18  # values of a layer worked on at once: 1 MB in float32


def grouped_mlp_max(
    xyz: Float[Tensor, "b n 3"],
    features: Float[Tensor, "b n c"] | None,
    centres: Float[Tensor, "b m 3"],
    index: Int[Tensor, "b m k"],
    weights: Sequence[Tensor],
    norms: Sequence[nn.Module],
) -> Float[Tensor, "b m d"]:
    """The maximum over each group of its members mapped by all layers, each with a ReLU.

    Args:
        xyz: the points.
        features: of the points, in the dtype of the weights as all others.
        centres: of the groups.
        index: members of each.
        weights: [D, C] of each layer, at least two; the first one's C is 3 + that of `features`.
        norms: of each layer, from `make_norm`.
    """
    p = None if features is None else features @ weights[0][:, 3:].T
    weights = [weights[0][:, :3], *weights[1:]]
    if isinstance(norms[0], nn.InstanceNorm1d):
        parts = zip(xyz, centres, [None] * len(xyz) if p is None else p, index, strict=True)
        return torch.stack([_groups(*cloud, weights=weights, norms=norms) for cloud in parts])
    first = torch.arange(len(xyz), device=xyz.device)[:, None, None] * xyz.shape[1]
    flat = None if p is None else p.flatten(0, 1)
    rows = xyz.flatten(0, 1), centres.flatten(0, 1), flat, (index + first).flatten(0, 1)
    return _groups(*rows, weights=weights, norms=norms).unflatten(0, centres.shape[:2])


def _groups(*points: Tensor | None, weights: Sequence[Tensor], norms: Sequence[Any]) -> Tensor:
    """The same of xyz, centres, p and index of all clouds in one list: [G, D]."""
    plain = [active(norm) for norm in norms]
    running = [None if uses_batch(n) else (n.running_mean, n.running_var) for n in plain]
    parameters = [
        part
        for weight, norm in zip(weights, plain, strict=True)
        for part in (weight, norm.weight, norm.bias)
    ]
    out, *found = _GroupedMaximum.apply(*points, plain[0].eps, running, *parameters)
    for norm, mean, var in zip(plain, found[::2], found[1::2], strict=True):
        track(norm, mean, var, points[-1].numel())  # type: ignore[union-attr]
    return out


@dataclass(frozen=True)
class _Members:
    """What the first layer makes of the members of some groups: Wx (x_j - c_i) + P_j (+ offset)."""

    xyz: Tensor
    centres: Tensor
    p: Tensor | None
    index: Tensor
    weight: Tensor
    offset: Tensor | None = None

    def relative(self, part: slice) -> Tensor:
        """[g * k, 3]."""
        index = self.index[part]
        members = self.xyz.index_select(0, index.flatten()).view(*index.shape, 3)
        return members.sub_(self.centres[part, None]).view(-1, 3)

    def __call__(self, part: slice) -> Tensor:
        """[g, k, c]."""
        return self.first(part, self.relative(part))

    def first(self, part: slice, relative: Tensor) -> Tensor:
        """The same from x_j - c_i."""
        index, weight = self.index[part], self.weight.T
        if self.p is not None:
            z = self.p.index_select(0, index.flatten()).addmm_(relative, weight)
        elif self.offset is not None:
            z = torch.addmm(self.offset, relative, weight)
        else:
            z = relative @ weight
        return z.view(*index.shape, -1)

    def scaled(self, layer: _Layer) -> _Members:
        """With the norm's affine map."""
        weight = self.weight * layer.h[:, None]
        if self.p is None:
            return replace(self, weight=weight, offset=layer.s)
        return replace(self, weight=weight, p=self.p * layer.h + layer.s)


class _Layer:
    """Affine map of one norm: y = relu(z h + s), and what its gradient needs."""

    def __init__(self, gamma: Tensor, beta: Tensor, mean: Tensor, var: Tensor, eps: float) -> None:
        self.mean, self.var = mean, var
        self.rstd = torch.rsqrt(var + eps)
        self.h = gamma * self.rstd
        self.s = beta - mean * self.h

    def gradient(self, first: Tensor, second: Tensor, rows: int) -> tuple[Tensor, ...]:
        """From sum(dy) and sum(dy z): dgamma, dbeta, and p, q, r with dz = p dy + q z + r."""
        dgamma = (second - self.mean * first) * self.rstd
        q = -self.h * self.rstd * dgamma / rows
        return dgamma, first, self.h, q, -self.h * first / rows - q * self.mean


class _Rows:
    """Sums over rows [..., C] that come in parts, in float64 about a first guess of their mean.

    With `products` of y'y instead of the squares alone.
    """

    def __init__(self, *, products: bool = False) -> None:
        self.count, self.products = 0, products
        self.shift: Tensor | None = None

    def add(self, z: Tensor) -> None:
        """Some more rows."""
        z = z.flatten(0, -2)
        if self.shift is None:
            self.shift = z.mean(0)
            self.first = torch.zeros_like(self.shift, dtype=torch.float64)
            self.second = torch.diag(self.first) if self.products else self.first.clone()
        z = z - self.shift
        self.count += len(z)
        self.first += z.sum(0)
        self.second += z.T @ z if self.products else z.square_().sum(0)

    def moments(self) -> tuple[Tensor, Tensor]:
        """Mean and biased variance [C], in the dtype of the rows."""
        assert self.shift is not None
        mean = self.first / self.count
        var = (self.second / self.count - mean.square()).clamp_min(0)
        return (mean + self.shift).to(self.shift.dtype), var.to(self.shift.dtype)

    def covariance(self) -> tuple[Tensor, Tensor]:
        """Mean [C] and covariance [C, C] in float64, if `products`."""
        assert self.shift is not None
        mean = self.first / self.count
        return mean + self.shift, self.second / self.count - torch.outer(mean, mean)


class _GroupedMaximum(torch.autograd.Function):
    """See the module. All rows lie as [groups, members, channels].

    `p` is the first convolution of the points' features, `running` each norm's mean and variance or
    None (then the members'), `parameters` each layer's weight, gamma and beta. To [G, D], and mean
    and biased variance of each norm's input, without gradient.
    """

    @staticmethod
    def forward(
        ctx: Any,
        xyz: Tensor,
        centres: Tensor,
        p: Tensor | None,
        index: Tensor,
        eps: float,
        running: Sequence[tuple[Tensor, Tensor] | None],
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        weights, gammas, betas = parameters[0::3], parameters[1::3], parameters[2::3]
        source = _Members(xyz, centres, p, index, weights[0])
        groups, members = index.shape
        training = [given is None for given in running]
        layers: list[_Layer] = []
        parts = _parts(groups, members * max(len(weight) for weight in weights))
        z: list[Tensor] = []  # of the layers between, part by part

        def norm(rows: _Rows) -> None:
            i = len(layers)
            mean, var = running[i] or rows.moments()
            layers.append(_Layer(gammas[i], betas[i], mean, var, eps))

        rows = _Rows()
        for part in parts if training[0] else []:
            rows.add(source(part))
        norm(rows)
        for level, weight in enumerate(weights[1:-1], 1):
            rows, make = _Rows(), _maker(source, layers, z, parts)
            after = []
            for i in range(len(parts)):
                after.append(matmul_t(make(i), weight))
                if training[level]:
                    rows.add(after[i])
            z += after
            norm(rows)

        weight, sign = weights[-1], torch.where(gammas[-1] < 0, -1.0, 1.0).to(xyz.dtype)
        signed = weight * sign[:, None]
        best = xyz.new_empty(groups, len(weight))
        where = torch.empty(groups, len(weight), dtype=torch.int64, device=xyz.device)
        rows, make = _Rows(products=True), _maker(source, layers, z, parts)
        for i, part in enumerate(parts):
            y = make(i)
            best[part], where[part] = max_over_rows(matmul_t(y, signed))
            if training[-1]:
                rows.add(y)
        best *= sign
        if running[-1] is None:
            mean, cov = rows.covariance()
            wide = weight.double()
            z_var = ((wide @ cov) * wide).sum(1).clamp_min(0).to(xyz.dtype)
            z_mean = (wide @ mean).to(xyz.dtype)
            ctx.mean, ctx.cov = mean, cov
        else:
            z_mean, z_var = running[-1]
        layers.append(_Layer(gammas[-1], betas[-1], z_mean, z_var, eps))
        out = F.relu(best * layers[-1].h + layers[-1].s)
        ctx.save_for_backward(xyz, centres, p, index, best, where, *weights, *z)
        ctx.layers, ctx.training, ctx.parts = layers, training, parts
        statistics = [value for layer in layers for value in (layer.mean, layer.var)]
        ctx.mark_non_differentiable(*statistics)
        return (out, *statistics)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor, *without: Tensor) -> tuple[Tensor | None, ...]:
        layers: list[_Layer] = ctx.layers
        xyz, centres, p, index, best, where, *rest = ctx.saved_tensors
        weights, z = rest[: len(layers)], rest[len(layers) :]
        source, parts = _Members(xyz, centres, p, index, weights[0]), ctx.parts
        groups, members = index.shape
        rows = groups * members
        grads: list[Tensor] = []  # of beta, gamma, weight, from the last layer to the first
        none = xyz.new_zeros(2, 1)

        # the last layer: nothing has its width but one row a group
        last, weight = layers[-1], weights[-1]
        grad = upstream * (best * last.h + last.s > 0)
        dgamma, dbeta, scale, b, _ = last.gradient(grad.sum(0), (grad * best).sum(0), rows)
        at_max = grad * scale  # D
        dweight = torch.zeros_like(weight)
        if ctx.training[-1]:
            a = -scale * dbeta / rows
            mean = ctx.mean.to(weight.dtype)
            product = weight.T @ (weight * b[:, None])  # W' diag(b) W, symmetric
            bias = a @ weight - mean @ product
            # the mean of z - mean(z) is zero, so that only the covariance is left of Y'Y
            dweight += b[:, None] * (weight @ (ctx.cov * rows).to(weight.dtype))
            dweight += torch.outer(a, mean * rows)
        make, sums = _maker(source, layers[:-1], z, parts), none
        dy: list[Tensor] = []
        for i, part in enumerate(parts):
            y = make(i)
            out = matmul_t(y, product, bias) if ctx.training[-1] else torch.zeros_like(y)
            _at_maxima(out, dweight, y, weight, at_max[part], where[part])
            out.mul_(y > 0)
            sums = sums + _sums(out, z[i - len(parts)] if z else source(part))
            dy.append(out)
        grads += [dbeta, dgamma, dweight]

        while z:  # the layers between
            here, z = z[-len(parts) :], z[: -len(parts)]
            level = len(z) // len(parts) + 1
            dgamma, dbeta, *affine = layers[level].gradient(sums[0], sums[1], rows)
            weight, transposed = weights[level], weights[level].T.contiguous()
            make, sums = _maker(source, layers[:level], z, parts), none
            dweight = torch.zeros_like(weight)
            for i, part in enumerate(parts):
                dz = _dz(dy[i], here[i], affine, ctx.training[level])
                y = make(i)
                dweight += t_matmul(dz.flatten(0, 1), y.flatten(0, 1))
                out = matmul_t(dz, transposed).mul_(y > 0)
                sums = sums + _sums(out, z[i - len(parts)] if z else source(part))
                dy[i] = out
            grads += [dbeta, dgamma, dweight]

        dgamma, dbeta, *affine = layers[0].gradient(sums[0], sums[1], rows)
        needs_xyz, needs_centres, needs_p = ctx.needs_input_grad[:3]
        dxyz = torch.zeros_like(xyz) if needs_xyz else None
        dcentres = torch.zeros_like(centres) if needs_centres else None
        dp = torch.zeros_like(p) if p is not None and needs_p else None
        dweight = torch.zeros_like(weights[0])
        for i, part in enumerate(parts):
            relative = source.relative(part)
            z_first = source.first(part, relative)
            dz = _dz(dy[i], z_first, affine, ctx.training[0]).flatten(0, 1)
            dweight += t_matmul(dz, relative)
            if dxyz is not None or dcentres is not None:
                drelative = dz @ weights[0]  # [g * k, 3]
                if dxyz is not None:
                    dxyz.index_add_(0, index[part].flatten(), drelative)
                if dcentres is not None:
                    dcentres[part] = -drelative.view(-1, members, 3).sum(1)
            if dp is not None:
                dp.index_add_(0, index[part].flatten(), dz)
        grads += [dbeta, dgamma, dweight]
        return dxyz, dcentres, dp, None, None, None, *grads[::-1]


def _sums(dy: Tensor, z: Tensor) -> Tensor:
    """[2, C] sums of dy and of dy z over all rows."""
    return torch.stack([dy.sum((0, 1)), (dy * z).sum((0, 1))])


def _parts(groups: int, values: int) -> list[slice]:
    """Groups in parts of about `_AT_ONCE` values, `values` a group, and larger of several threads.

    Each operation on a part wakes them: with two threads small parts took 1.7 times as long.
    """
    threads = torch.get_num_threads()
    step = max(1, _AT_ONCE * (4 * threads if threads > 1 else 1) // values)
    return [slice(i, min(i + step, groups)) for i in range(0, groups, step)]


def _maker(
    source: _Members, layers: Sequence[_Layer], z: Sequence[Tensor], parts: Sequence[slice]
) -> Callable[[int], Tensor]:
    """A function from the number of a part to y of the last of `layers` there: [g, k, c]."""
    layer = layers[-1]
    if z:
        last = z[-len(parts) :]
        return lambda i: torch.addcmul(layer.s, last[i], layer.h).relu_()
    scaled = source.scaled(layer)
    return lambda i: scaled(parts[i]).relu_()


def _dz(dy: Tensor, z: Tensor, affine: Sequence[Tensor], training: bool) -> Tensor:
    """The gradient of z, in the place of dy."""
    scale, slope, bias = affine
    dy.mul_(scale)
    return dy.addcmul_(z, slope).add_(bias) if training else dy


def _at_maxima(
    dy: Tensor, dweight: Tensor, y: Tensor, weight: Tensor, at_max: Tensor, where: Tensor
) -> None:
    """Add D W to dy [g, k, c] and D'y to dweight [d, c]; D has one entry a group and channel."""
    (g, k, c), d = y.shape, len(weight)
    rows = (where + k * torch.arange(g, device=y.device)[:, None]).flatten()  # [g * d]
    at_max = at_max[:, :, None]
    dy.view(-1, c).index_add_(0, rows, (at_max * weight).view(-1, c))
    dweight += y.view(-1, c).index_select(0, rows).view(g, d, c).mul_(at_max).sum(0)
