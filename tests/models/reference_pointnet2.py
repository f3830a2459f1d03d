"""PointNet++ written straight: groups as tensors [B, C, K, M], 2D convolutions and batch norms."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.geometry.neighbours import farthest_point_sampling
from qs3.models.base import PointClassifier
from qs3.models.pointnet2 import GroupedMLP


def take(x: Tensor, index: Tensor) -> Tensor:
    """Rows of each cloud, by one advanced indexing: [b, n, c], [b, ...] -> [b, ..., c]."""
    batch = torch.arange(len(x), device=x.device).view(-1, *[1] * (index.ndim - 1)).expand_as(index)
    return x[batch, index]


def ball_query_reference(x: Tensor, centres: Tensor, radius: float, count: int) -> Tensor:
    """Sort all indices of each row; those outside count as n."""
    n = x.shape[1]
    squares = (centres[:, :, None] - x[:, None]).square()
    squares = squares[..., 0] + squares[..., 1] + squares[..., 2]
    index = torch.arange(n, device=x.device).expand_as(squares).clone()
    index[squares >= radius**2] = n
    index = index.sort(dim=2)[0][:, :, :count]
    first = index[:, :, :1].expand_as(index)
    index = torch.where(index == n, first, index)
    missing = count - index.shape[2]
    return torch.cat([index, index[:, :, :1].expand(-1, -1, missing)], 2) if missing > 0 else index


class StraightMLP(nn.Module):
    """`GroupedMLP` with copies of its parameters."""

    def __init__(self, twin: GroupedMLP) -> None:
        super().__init__()
        dtype = twin.linears[0].weight.dtype
        self.convolutions, self.norms = nn.ModuleList(), nn.ModuleList()
        for linear, norm in zip(twin.linears, twin.norms, strict=True):
            o, i = linear.weight.shape
            convolution = nn.Conv2d(i, o, 1, bias=False, dtype=dtype)
            convolution.weight.data.copy_(linear.weight[:, :, None, None])
            if isinstance(norm, nn.BatchNorm1d):
                copy: nn.Module = nn.BatchNorm2d(o, dtype=dtype)
                copy.load_state_dict(norm.state_dict())
            else:
                copy = nn.InstanceNorm2d(o, affine=True, dtype=dtype)
                copy.weight.data.copy_(norm.weight)
                copy.bias.data.copy_(norm.bias)
            self.convolutions.append(convolution.to(linear.weight))
            self.norms.append(copy.to(linear.weight))

    def forward(
        self, xyz: Tensor, features: Tensor | None, centres: Tensor, index: Tensor
    ) -> Tensor:
        groups = take(xyz, index) - centres[:, :, None]
        if features is not None:
            groups = torch.cat([groups, take(features, index)], dim=3)
        x = groups.permute(0, 3, 2, 1)  # [b, c, k, m]
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            x = F.relu(norm(convolution(x)))
        return x.max(2)[0].transpose(1, 2)


class StraightPointNet2(nn.Module):
    """The whole classifier; weights of `twin`."""

    def __init__(self, twin: PointClassifier) -> None:
        super().__init__()
        self.scales = [level.scales for level in twin.backbone.levels]
        self.centres = [level.centres for level in twin.backbone.levels]
        self.levels = nn.ModuleList(
            nn.ModuleList(StraightMLP(mlp) for mlp in level.mlps) for level in twin.backbone.levels
        )
        self.last, self.head = StraightMLP(twin.backbone.last), twin.head

    def forward(self, points: Tensor) -> Tensor:
        xyz, features = points, None
        for i, mlps in enumerate(self.levels):
            centres = take(xyz, farthest_point_sampling(xyz, self.centres[i]))
            balls = [
                ball_query_reference(xyz.detach(), centres.detach(), s.radius, s.members)
                for s in self.scales[i]
            ]
            parts = [m(xyz, features, centres, ball) for m, ball in zip(mlps, balls, strict=True)]
            xyz, features = centres, torch.cat(parts, dim=2)
        b, m, _ = xyz.shape
        everything = torch.arange(m, device=xyz.device).expand(b, 1, m)
        return self.head(self.last(xyz, features, xyz.new_zeros(b, 1, 3), everything).squeeze(1))
