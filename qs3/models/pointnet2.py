"""PointNet++ (Qi et al., NeurIPS 2017), single-scale (SSG) and multi-scale grouping (MSG).

Without normals and without biases before norms: 1,464,650 (SSG) and 1,735,146 parameters (MSG) for
10 classes. MSG is what SimpleView, and so the paper's tables, call PointNet++. Farthest point
sampling in the net starts at point 0, so the order of the points matters a little.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3 import kernels as fast
from qs3.geometry.ball_query import ball_queries
from qs3.geometry.neighbours import farthest_point_sampling, gather
from qs3.kernels.grouped_mlp_max import grouped_mlp_max
from qs3.kernels.norms import Norm, make_norm, normed
from qs3.kernels.pointwise_max import max_over_members
from qs3.models.base import Backbone, Features, PointClassifier, with_head
from qs3.utils.settings import checked


@dataclass(frozen=True)
class Scale:
    """One grouping of a level: radius in the unit of the cloud, members of a group, widths."""

    radius: float
    members: int
    widths: tuple[int, ...]


SSG = (
    (512, (Scale(0.2, 32, (64, 64, 128)),)),
    (128, (Scale(0.4, 64, (128, 128, 256)),)),
)
MSG = (
    (512, (Scale(0.1, 16, (32, 32, 64)), *SSG[0][1], Scale(0.4, 128, (64, 96, 128)))),
    (128, (Scale(0.2, 32, (64, 64, 128)), *SSG[1][1], Scale(0.8, 128, (128, 128, 256)))),
)


class GroupedMLP(nn.Module):
    """Linear - norm - ReLU for each width, on the members of each group, then the maximum.

    Args:
        channels: C of the points' features, 0 if they have none.
        widths: of the layers, at least two.
        norm: see `qs3.kernels.norms`; statistics are of all members of all groups, of the batch or
            ("instance") of each cloud.
    """

    def __init__(self, channels: int, widths: Sequence[int], *, norm: Norm = "batch") -> None:
        super().__init__()
        sizes = (3 + channels, *widths)
        self.linears = nn.ModuleList(nn.Linear(i, o, bias=False) for i, o in pairwise(sizes))
        self.norms = nn.ModuleList(make_norm(norm, width) for width in widths)
        for linear in self.linears:
            assert isinstance(linear, nn.Linear)
            nn.init.kaiming_normal_(linear.weight)

    def forward(
        self,
        xyz: Float[Tensor, "b n 3"],
        features: Float[Tensor, "b n c"] | None,
        centres: Float[Tensor, "b m 3"],
        index: Int[Tensor, "b m k"],
    ) -> Float[Tensor, "b m d"]:
        """The maximum over each group of the mapped (x_j - c_i, f_j), in float32 at least."""
        weights: list[Any] = [linear.weight for linear in self.linears]
        with torch.autocast(xyz.device.type, enabled=False):
            xyz, centres = xyz.to(weights[0].dtype), centres.to(weights[0].dtype)
            features = None if features is None else features.to(weights[0].dtype)
            if fast.usable(xyz):
                return grouped_mlp_max(xyz, features, centres, index, weights, list(self.norms))
            x = gather(xyz, index) - centres[:, :, None]  # [b, m, k, 3]
            if features is not None:
                x = torch.cat([x, gather(features, index)], dim=3)  # [b, m, k, 3 + c]
            for linear, norm in zip(self.linears, self.norms, strict=True):
                x = normed(norm, linear(x)).relu()
            return max_over_members(x)


class SetAbstraction(nn.Module):
    """Farthest points as centres, a ball about each at one or several scales, an MLP on each ball.

    Args:
        channels: C of the points' features, 0 for none.
        centres: M.
        scales: their features are put side by side.
    """

    def __init__(self, channels: int, centres: int, scales: Sequence[Scale], norm: Norm) -> None:
        super().__init__()
        self.centres, self.scales = centres, tuple(scales)
        self.mlps = nn.ModuleList(GroupedMLP(channels, s.widths, norm=norm) for s in scales)
        self.out_channels = sum(s.widths[-1] for s in scales)

    def forward(
        self, xyz: Float[Tensor, "b n 3"], features: Float[Tensor, "b n c"] | None
    ) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m d"]]:
        """Centres and their features."""
        centres = gather(xyz, farthest_point_sampling(xyz, self.centres))
        radii, members = zip(*((s.radius, s.members) for s in self.scales), strict=True)
        balls = ball_queries(xyz.detach(), centres.detach(), radii, members)
        parts = [
            mlp(xyz, features, centres, ball) for mlp, ball in zip(self.mlps, balls, strict=True)
        ]
        return centres, torch.cat(parts, dim=2)


class PointNet2(Backbone):
    """Two set abstractions, then one group of all: 256, 512, 1024 and the maximum."""

    feature_dim = 1024
    least_points = 513  # more than there are centres: fewer start over

    def __init__(self, *, variant: Literal["msg", "ssg"] = "msg", norm: Norm = "batch") -> None:
        super().__init__()
        channels, levels = 0, []
        for centres, scales in SSG if variant == "ssg" else MSG:
            levels.append(SetAbstraction(channels, centres, scales, norm))
            channels = levels[-1].out_channels
        self.levels = nn.ModuleList(levels)
        self.last = GroupedMLP(channels, (256, 512, 1024), norm=norm)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """[B, 1024]; it has no features of all N points."""
        xyz, features = points, None
        for level in self.levels:
            xyz, features = level(xyz, features)
        b, m, _ = xyz.shape
        everything = torch.arange(m, device=xyz.device).expand(b, 1, m)
        origin = xyz.new_zeros(b, 1, 3)  # the last level sees absolute coordinates
        return Features(self.last(xyz, features, origin, everything).squeeze(1), None)


@checked
def pointnet2(
    num_classes: int,
    variant: Literal["msg", "ssg"] = "msg",
    norm: Norm = "batch",
    dropout: float = 0.5,
) -> PointClassifier:
    """PointNet++ with its class head (512, 256; ReLU)."""
    backbone = PointNet2(variant=variant, norm=norm)
    return with_head(
        backbone, num_classes, dropout=dropout, negative_slope=0.0, hidden_bias=False, norm=norm
    )
