"""RS-CNN, single-scale (Liu et al., "Relation-Shape CNN", CVPR 2019).

1,281,763 parameters for 10 classes (the released code has 32 more, which it never uses).
The vector h_ij that relates a point j to a centre i is |d|, xi, xj, xj - xi in the paper,
d = xj - xi; what it is in code is the switch `relation`:
- "released": as in SimpleView's repository, which the paper's tables come from. xj was overwritten
  by d, and xi is that of the ball's first member: h = (|d_j|, d_first, d_j, d_j). Which member is
  first follows from the order of the points.
- "paper": h as the paper has it, in absolute coordinates, on balls as in "released".
"""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3 import kernels as fast
from qs3.geometry.ball_query import ball_query
from qs3.geometry.neighbours import farthest_point_sampling, gather
from qs3.kernels.norms import Norm, make_norm, normed
from qs3.kernels.pointwise_max import max_over_members
from qs3.kernels.rsconv import relations, rs_conv
from qs3.models.base import Backbone, Features, PointClassifier, with_head
from qs3.utils.settings import checked

Relation = Literal["released", "paper"]
# centres, radius (of a cloud in the unit ball), slots of a ball, of each layer
LEVELS = ((512, 0.23, 48), (128, 0.32, 64))


class RSConv(nn.Module):
    """One layer: features at the centres from those of the points in their balls.

    Equation 4, with M two linear layers and a norm and ReLU between:
    relu(norm(W max_j relu(norm(M(h_ij) * x_ij)))) with x = (d, f), where points have features f.

    Args:
        channels: of the points' features; 0 at the first layer, which raises d to 16 channels.
        hidden: channels between the two layers of M.
        out_channels: of the result.
    """

    def __init__(
        self,
        channels: int,
        hidden: int,
        out_channels: int,
        relation: Relation,
        *,
        norm: Norm = "batch",
    ) -> None:
        super().__init__()
        inner = channels + 3 if channels else 16
        self.relation = relation
        self.raising = None if channels else nn.Linear(3, inner)
        self.raising_norm = None if channels else make_norm(norm, inner)
        self.mapping, self.weighing = nn.Linear(10, hidden), nn.Linear(hidden, inner)  # M
        self.mapping_norm, self.norm = make_norm(norm, hidden), make_norm(norm, inner)
        self.channel_raising = nn.Linear(inner, out_channels)
        self.channel_norm = make_norm(norm, out_channels)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.kaiming_normal_(module.weight)
                nn.init.zeros_(module.bias)

    def forward(
        self,
        points: Float[Tensor, "b n 3"],
        features: Float[Tensor, "b n c"] | None,
        centres: Float[Tensor, "b m 3"],
        index: Int[Tensor, "b m k"],
    ) -> Float[Tensor, "b m d"]:
        """Features of the points, and the members of the centres' balls, to those of the centres.

        With instance norms the kernel takes one cloud at a time.
        """
        form = self._fast if fast.usable(points) else self._plain
        best = form(points, features, centres, index)
        return normed(self.channel_norm, self.channel_raising(best)).relu()

    def _plain(
        self, points: Tensor, features: Tensor | None, centres: Tensor, index: Tensor
    ) -> Tensor:
        d = gather(points, index) - centres[:, :, None]  # [b, m, k, 3]
        if self.relation == "paper":
            xi = centres[:, :, None].expand_as(d)
            xj = xi + d
        else:  # of the ball's first member
            xi, xj = d[:, :, :1].expand_as(d), d
        h = torch.cat([d.norm(dim=3, keepdim=True), xi, xj, d], dim=3)  # [b, m, k, 10]
        w = self.weighing(normed(self.mapping_norm, self.mapping(h)).relu())
        if self.raising is not None:
            assert self.raising_norm is not None
            x = normed(self.raising_norm, self.raising(d)).relu()
        else:
            assert features is not None
            x = torch.cat([d, gather(features, index)], dim=3)  # [b, m, k, 3 + c]
        return max_over_members(normed(self.norm, w * x).relu())

    def _fast(
        self, points: Tensor, features: Tensor | None, centres: Tensor, index: Tensor
    ) -> Tensor:
        raising = None
        if self.raising is not None and self.raising_norm is not None:
            raising = self.raising, self.raising_norm
        best = rs_conv(
            relations(points, centres, index, self.relation),
            None if features is None else features.flatten(0, 1),
            self.relation,
            mapping=(self.mapping, self.mapping_norm),
            weighing=self.weighing,
            raising=raising,
            norm=self.norm,
        )
        return best.unflatten(0, centres.shape[:2])


class RSCNN(Backbone):
    """Two relation-shape convolutions, then a layer on all centres and its maximum.

    Farthest point sampling starts at point 0. The order of the points matters through that, through
    balls with more points than slots, and through `relation="released"`. No gradient reaches the
    points. A point has no features of its own.
    """

    feature_dim = 1024
    least_points = LEVELS[0][0] + 1  # more than there are centres: fewer start over

    def __init__(self, *, relation: Relation = "released", norm: Norm = "batch") -> None:
        super().__init__()
        self.relation, self.norm = relation, norm
        self.layers = nn.ModuleList(
            [RSConv(0, 64, 128, relation, norm=norm), RSConv(128, 128, 512, relation, norm=norm)]
        )
        self.last = nn.Linear(3 + 512, self.feature_dim)
        self.last_norm = make_norm(norm, self.feature_dim)
        nn.init.kaiming_normal_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Maximum over the 128 centres, in float32 at least."""
        with torch.autocast(points.device.type, enabled=False):
            points = points.detach().to(self.last.weight.dtype)
            if self.norm == "instance" and fast.usable(points):
                return Features(torch.cat([self._forward(cloud[None]) for cloud in points]), None)
            return Features(self._forward(points), None)

    def _forward(self, points: Tensor) -> Tensor:
        features = None
        for layer, (count, radius, slots) in zip(self.layers, LEVELS, strict=True):
            centres = gather(points, farthest_point_sampling(points, count))
            index = ball_query(points, centres, radius, slots)
            features = layer(points, features, centres, index)
            points = centres
        assert features is not None
        x = self.last(torch.cat([points, features], dim=2))  # [b, 128, 1024]
        return normed(self.last_norm, x).relu().amax(1)


@checked
def rscnn(
    num_classes: int,
    relation: Relation = "released",
    norm: Norm = "batch",
    dropout: float = 0.5,
) -> PointClassifier:
    """RS-CNN with its class head (512, 256; ReLU)."""
    backbone = RSCNN(relation=relation, norm=norm)
    return with_head(
        backbone, num_classes, dropout=dropout, negative_slope=0.0, hidden_bias=False, norm=norm
    )
