"""The nets once more for inference, in plain operations that a graph can hold.

The layers of `qs3.models` work in blocks, leave torch for numpy and keep what gradients need; none
of that can be written down as a graph for any number of clouds. Here each layer in eval mode is as
its paper has it. The weights are those of the net itself, and tests compare the logits.
"""

from __future__ import annotations

from functools import singledispatch

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.models.base import Backbone, PointClassifier
from qs3.models.dgcnn import DGCNN
from qs3.models.fast.edgeconv import EdgeConv
from qs3.models.fast.rsconv import RSConv
from qs3.models.grouped import GroupedMLP
from qs3.models.norms import active
from qs3.models.pointdan import NodeModule, PointDanBackbone
from qs3.models.pointnet2 import PointNet2, SetAbstraction
from qs3.models.projection import _TABLE, _TINY, CAMERA_DISTANCE
from qs3.models.rscnn import LEVELS, RSCNN
from qs3.models.simpleview import SimpleView


class Plain(nn.Module):
    """A classifier for [B, N, 3] with any B, in eval mode only; input is not checked.

    Args:
        net: one of ours, or any module of clouds to logits, which is then called as it is.
    """

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b c"]:
        """Logits of prepared clouds."""
        if not isinstance(self.net, PointClassifier):
            return self.net(points)
        return self.net.head(features(self.net.backbone, points))


@singledispatch
def features(net: Backbone, points: Tensor) -> Tensor:
    """One vector a cloud, [B, N, 3] to [B, D]: of a backbone that is not below by itself."""
    return net(points).global_


@singledispatch
def least_points(net: nn.Module) -> int:
    """With how many points at least the layers always do the same."""
    return 1


@least_points.register
def _(net: DGCNN) -> int:
    return net.k


@least_points.register
def _(net: PointDanBackbone) -> int:
    return max(net.node_module.nodes, net.node_module.neighbours)


@least_points.register(PointNet2)
@least_points.register(RSCNN)
def _(net: nn.Module) -> int:
    return LEVELS[0][0] + 1  # more than there are centres; PointNet++ has as many


@features.register
def _(net: DGCNN, points: Tensor) -> Tensor:
    k = _at_most(net.k, points.shape[1])
    x, levels = points, []
    if net.transform is not None:
        neighbour = _rows(points, _nearest(points, k))  # [b, n, k, 3]
        centre = points[:, :, None].expand_as(neighbour)
        edges = torch.cat([neighbour - centre, centre], dim=3)
        y = net.transform.edges(edges.flatten(0, 2)).unflatten(0, (-1, k)).amax(1)
        y = net.transform.points(y).unflatten(0, points.shape[:2]).amax(1)
        turn = net.transform.cloud(y).view(-1, 3, 3) + torch.eye(3, dtype=y.dtype)
        x = points @ turn.transpose(1, 2)
    for layer in net.edge_convs:
        assert isinstance(layer, EdgeConv)
        x = _edge_conv(layer, x, _nearest(x, k))
        levels.append(x)
    y = F.linear(torch.cat(levels, dim=2), net.conv5.weight)
    if net.norm5 is not None:
        y = F.leaky_relu(_normed(net.norm5, y), 0.2)
    return y.amax(1) if net.variant == "defrec" else torch.cat([y.amax(1), y.mean(1)], dim=1)


def _edge_conv(layer: EdgeConv, x: Tensor, index: Tensor) -> Tensor:
    """W1 x_j + (W2 - W1) x_i, norm, LeakyReLU, maximum over j; see `qs3.models.fast.edgeconv`."""
    w1, w2 = layer.linear.weight.split(x.shape[2], dim=1)
    norm = active(layer.norm)
    if norm.running_mean is None:  # statistics of each cloud's edges: they have to be there
        z = _rows(x @ w1.T, index) + (x @ (w2 - w1).T)[:, :, None]  # [b, n, k, d]
        return F.leaky_relu(_normed(norm, z), layer.negative_slope).amax(2)
    h, shift = _affine(norm)
    best = _rows(x @ (h[:, None] * w1).T, index).amax(2)  # [b, n, d]
    return F.leaky_relu(best + x @ (h[:, None] * (w2 - w1)).T + shift, layer.negative_slope)


@features.register
def _(net: PointNet2, points: Tensor) -> Tensor:
    xyz, found = points, None
    for level in net.levels:
        assert isinstance(level, SetAbstraction)
        chosen = _rows(xyz, _farthest(xyz, level.centres))
        squares, parts = _squares(chosen, xyz), []
        for mlp, scale in zip(level.mlps, level.scales, strict=True):
            assert isinstance(mlp, GroupedMLP)
            ball = _ball(squares < scale.radius**2, scale.members)
            parts.append(_grouped(mlp, xyz, found, chosen, ball))
        xyz, found = chosen, torch.cat(parts, dim=2)
    assert found is not None
    z = torch.cat([xyz, found], dim=2)[:, None]  # one group of all, in absolute coordinates
    return _mapped(net.last, z)[:, 0]


def _grouped(
    layer: GroupedMLP, xyz: Tensor, found: Tensor | None, centres: Tensor, index: Tensor
) -> Tensor:
    z = _rows(xyz, index) - centres[:, :, None]  # [b, m, k, 3]
    if found is not None:
        z = torch.cat([z, _rows(found, index)], dim=3)
    return _mapped(layer, z)


def _mapped(layer: GroupedMLP, z: Tensor) -> Tensor:
    """The layers on each member of [b, m, k, c], and the maximum over k."""
    for linear, norm in zip(layer.linears, layer.norms, strict=True):
        z = _normed(norm, linear(z)).relu()
    return z.amax(2)


@features.register
def _(net: RSCNN, points: Tensor) -> Tensor:
    found = None
    for layer, (count, radius, slots) in zip(net.layers, LEVELS, strict=True):
        assert isinstance(layer, RSConv)
        start = _farthest(points, count)
        centres = _rows(points, start)
        squares = _squares(centres, points)
        inside = squares < radius**2
        if net.relation == "original":  # the centre, then points that lie elsewhere
            index = _ball(inside & (squares > 0), slots, start[:, :, None])
            index = torch.cat([start[:, :, None], index], dim=2)
        else:
            index = _ball(inside, slots)
        d = _rows(points, index) - centres[:, :, None]  # [b, m, k, 3]
        first, second = d[:, :, :1].expand_as(d), d  # what xi and xj are, see `qs3.models.rscnn`
        if net.relation == "paper":
            first = centres[:, :, None].expand_as(d)
            second = first + d
        h = torch.cat([d.square().sum(3, keepdim=True).sqrt(), first, second, d], dim=3)
        w = layer.weighing(_normed(layer.mapping_norm, layer.mapping(h)).relu())
        if layer.raising is not None:
            assert layer.raising_norm is not None
            x = _normed(layer.raising_norm, layer.raising(d)).relu()
        else:
            assert found is not None
            x = torch.cat([d, _rows(found, index)], dim=3)
        z = _normed(layer.norm, w * x).relu().amax(2)  # [b, m, c]
        found = _normed(layer.channel_norm, layer.channel_raising(z)).relu()
        points = centres
    assert found is not None
    return _normed(net.last_norm, net.last(torch.cat([points, found], dim=2))).relu().amax(1)


@features.register
def _(net: PointDanBackbone, points: Tensor) -> Tensor:
    x = net.first(points @ net.input_transform(points))
    x = x @ net.feature_transform(x)
    return net.norm(net.last(_nodes(net.node_module, points, x)).amax(1))


def _nodes(module: NodeModule, x: Tensor, f: Tensor) -> Tensor:
    """`NodeModule`: each point's features, and what it gets from its nearest nodes."""
    k = _at_most(module.neighbours, x.shape[1])
    index = _farthest(x, module.nodes)
    place, feature = _rows(x, index), _rows(f, index)
    ball = _ball(_squares(place, x) < module.radius**2, k)
    towards = _rows(x, ball) - place[:, :, None]  # [b, m, k, 3]
    how_far = torch.tanh(module.offset(_rows(f, ball) - feature[:, :, None]))
    place = place + (how_far * towards).mean(2)
    squares = _squares(place, x)  # [b, m, n]
    nodes = _rows(module.residual(f), squares.topk(k, dim=2, largest=False)[1]).amax(2)
    three = squares.transpose(1, 2).topk(min(3, module.nodes), dim=2, largest=False)[1]
    weight = 1 / (x[:, :, None] - _rows(place, three)).square().sum(3).clamp_min(1e-10)
    weight = weight / weight.sum(2, keepdim=True)
    return torch.cat([f, (weight[..., None] * _rows(nodes, three)).sum(2)], dim=2)


@features.register
def _(net: SimpleView, points: Tensor) -> Tensor:
    images = _depth_images(net, points)  # [b, v, size, size]
    return net.images(images.flatten(0, 1)[:, None]).view(points.shape[0], -1)


def _depth_images(net: SimpleView, points: Tensor) -> Tensor:
    """`qs3.models.projection.depth_images`; points outside an image fall into a last pixel."""
    size = net.image_size
    x, y, z = points.unbind(2)
    axes = (x, z, -y) if net.up == "z" else (x, y, z)
    images = []
    for view in net.views:
        rows, columns, depth = (sign * axes[axis] for axis, sign in _TABLE[view])
        depth = depth + CAMERA_DISTANCE  # [b, n]
        row = ((rows / (depth + _TINY) + 1) * size / 2 - 0.5).ceil()
        column = ((columns / (depth + _TINY) + 1) * size / 2 - 0.5).ceil()
        seen = (row >= 0) & (row < size) & (column >= 0) & (column < size) & (depth >= 0)
        pixel = torch.where(seen, row * size + column, float(size * size)).long()
        empty = torch.zeros_like(depth[:, :1]).expand(-1, size * size + 1)
        if net.pixel == "nearest":
            flat = (empty + torch.inf).scatter_reduce(1, pixel, depth, "amin")
            flat = torch.where(torch.isinf(flat), 0.0, flat)
        else:
            weight = torch.where(seen, 1 / (depth + _TINY), 0.0)
            total = empty.scatter_add(1, pixel, weight)
            flat = empty.scatter_add(1, pixel, depth * weight)
            flat = flat / torch.where(total == 0, 1.0, total)
        images.append(flat[:, :-1].unflatten(1, (size, size)))
    return torch.stack(images, dim=1)


def _at_most(k: int, n: int) -> int:
    """The smaller one, as a plain number where n is a symbol."""
    return k if n >= k else n


def _affine(norm: nn.Module) -> tuple[Tensor, Tensor]:
    """Scale and shift of a norm with running statistics."""
    plain = active(norm)
    assert plain.running_mean is not None
    assert plain.running_var is not None
    h = plain.weight * torch.rsqrt(plain.running_var + plain.eps)
    return h, plain.bias - h * plain.running_mean


def _normed(norm: nn.Module, z: Float[Tensor, "b *places c"]) -> Float[Tensor, "b *places c"]:
    """A norm of the last axis; an instance norm has the statistics of a cloud's places."""
    plain = active(norm)
    if plain.running_mean is not None:
        h, shift = _affine(plain)
        return z * h + shift
    places = list(range(1, z.ndim - 1))
    centred = z - z.mean(places, keepdim=True)
    variance = centred.square().mean(places, keepdim=True)
    return centred * torch.rsqrt(variance + plain.eps) * plain.weight + plain.bias


def _rows(x: Float[Tensor, "b n c"], index: Int[Tensor, "b ..."]) -> Float[Tensor, "b ... c"]:
    """Rows of each cloud, taken from one list of all clouds' rows."""
    b, n, _ = x.shape
    first = torch.arange(b, device=x.device) * n
    flat = index.flatten(1) + first[:, None]  # [b, r]
    return x.flatten(0, 1).index_select(0, flat.flatten()).view(*index.shape, x.shape[2])


def _nearest(x: Float[Tensor, "b n c"], k: int) -> Int[Tensor, "b n k"]:
    """The k nearest points of each, itself included (|x_i|^2 orders nothing)."""
    x = x - x.mean(1, keepdim=True)
    distance = x.square().sum(2)[:, None] - 2 * (x @ x.transpose(1, 2))
    return distance.topk(k, dim=2, largest=False)[1]


def _squares(centres: Float[Tensor, "b m 3"], points: Float[Tensor, "b n 3"]) -> Tensor:
    """Squared distances [b, m, n], coordinate by coordinate."""
    parts = [(centres[:, :, None, i] - points[:, None, :, i]).square() for i in range(3)]
    return parts[0] + parts[1] + parts[2]


def _ball(inside: Tensor, k: int, fill: Tensor | None = None) -> Int[Tensor, "b m k"]:
    """Columns of the first k that are inside, filled up with `fill` [b, m, 1] or the first one.

    [b, m, n] bool; every ball holds a point if there is no `fill`.
    """
    n = inside.shape[2]
    column = torch.arange(n, dtype=torch.int32, device=inside.device)
    found = torch.where(inside, column, n).topk(_at_most(k, n), dim=2, largest=False)[0].long()
    rest = found[:, :, :1] if fill is None else fill
    found = torch.where(found < n, found, rest)
    if n < k:
        found = torch.cat([found, rest.expand(-1, -1, k - n)], dim=2)
    return found


def _farthest(x: Float[Tensor, "b n 3"], count: int) -> Int[Tensor, "b m"]:
    """Farthest point sampling from point 0, one step a point; it starts over after all points."""
    from torch._higher_order_ops.scan import scan  # a loop that a graph can hold

    total = x.shape[1]
    if count > total:
        return _farthest(x, total)[:, torch.arange(count, device=x.device) % total]
    x = x - x.mean(1, keepdim=True)

    def step(state: tuple[Tensor, Tensor], _: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor]:
        nearest, last = state  # [b, n], [b, 1]
        place = x.gather(1, last[:, :, None].expand(-1, -1, 3))
        distance = (x - place).square().sum(2)
        nearest = torch.minimum(nearest, distance).scatter(1, last, -1.0)  # never again
        following = nearest.argmax(1, keepdim=True)
        return (nearest, following), last.clone()

    nearest = torch.full_like(x[:, :, 0], torch.inf)
    last = torch.zeros_like(x[:, :1, 0], dtype=torch.int64)
    _, taken = scan(step, (nearest, last), torch.arange(count, device=x.device))
    return taken[:, :, 0].T  # [b, m]
