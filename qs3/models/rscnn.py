"""RS-CNN, single-scale (Liu et al., "Relation-Shape CNN", CVPR 2019).

1,281,763 parameters for 10 classes (the released code has 32 more, which it never uses). How the
layers are computed is in `rsconv`. The vector h_ij that relates a point j to a centre i is
|d|, xi, xj, xj - xi in the paper, d = xj - xi; what it is in code is the switch `relation`:
- "released": as in SimpleView's repository, which the paper's tables come from. xj was overwritten
  by d, and xi is that of the ball's first member: h = (|d_j|, d_first, d_j, d_j). Which member is
  first follows from the order of the points.
- "original": as in the authors' repository. xj was overwritten there too; a ball is the centre and
  then points at a distance > 0, so that h = (|d|, 0, d, d), and has one slot more.
- "paper": h as the paper has it, in absolute coordinates, on balls as in "released".
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.errors import ConfigError
from qs3.geometry.ball_query import ball_query
from qs3.geometry.neighbours import farthest_point_sampling, gather
from qs3.models.base import Backbone, ClassHead, Features, PointClassifier
from qs3.models.fast.rsconv import RSConv, relations
from qs3.models.norms import make_norm, norm_rows

# centres, radius (of a cloud in the unit ball), slots of a ball, of each layer
LEVELS = ((512, 0.23, 48), (128, 0.32, 64))


class RSCNN(Backbone):
    """Two relation-shape convolutions, then a layer on all centres and its maximum.

    Farthest point sampling starts at point 0. The order of the points matters through that, through
    balls with more points than slots, and through `relation="released"`. No gradient reaches the
    points. A point has no features of its own.

    Args:
        relation: "released", "original" or "paper", see the module.
        norm: see `qs3.models.norms`; statistics are of all slots of all balls.
    """

    feature_dim = 1024

    def __init__(self, *, relation: str = "released", norm: str = "batch") -> None:
        super().__init__()
        if relation not in ("released", "original", "paper"):
            raise ConfigError(
                f"relation must be 'released', 'original' or 'paper', got {relation!r}"
            )
        self.relation, self.norm = relation, norm
        self.layers = nn.ModuleList(
            [RSConv(0, 64, 128, norm=norm), RSConv(128, 128, 512, norm=norm)]
        )
        self.last = nn.Linear(3 + 512, self.feature_dim)
        self.last_norm = make_norm(norm, self.feature_dim)
        nn.init.kaiming_normal_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Maximum over the 128 centres, in float32 at least."""
        with torch.autocast(points.device.type, enabled=False):
            points = points.detach().to(self.last.weight.dtype)
            if self.norm == "instance":
                return Features(torch.cat([self._forward(cloud[None]) for cloud in points]), None)
            return Features(self._forward(points), None)

    def compile(self, *args: Any, **settings: Any) -> None:
        """Nothing: torch 2.13's compiler gives other numbers in training, whatever its backend."""

    def _forward(self, points: Tensor) -> Tensor:
        b = len(points)
        features = None
        for layer, (count, radius, slots) in zip(self.layers, LEVELS, strict=True):
            start = farthest_point_sampling(points, count)
            centres = gather(points, start)
            index = group(points, centres, start, radius, slots, self.relation)
            features = layer(
                features, relations(points, centres, index, self.relation), self.relation
            )
            points = centres
        assert features is not None
        rows = torch.cat([points.flatten(0, 1), features], dim=1)  # [b * 128, 515]
        rows = norm_rows(self.last_norm, self.last(rows))
        return rows.relu().view(b, -1, self.feature_dim).amax(1)


def group(
    points: Float[Tensor, "b n 3"],
    centres: Float[Tensor, "b m 3"],
    index: Int[Tensor, "b m"],
    radius: float,
    slots: int,
    relation: str,
) -> Int[Tensor, "b m k"]:
    """Members of each ball, the distinct ones first, then copies of the first.

    Args:
        points: the cloud.
        centres: some of the points.
        index: which.
        radius: of a ball, strict, in the unit of the cloud.
        slots: members of a ball; with `relation="original"` those beside the centre.
        relation: see the module.
    """
    if relation != "original":
        return ball_query(points, centres, radius, slots)
    # Copies of a centre lie at distance 0 and are no members, so look for as many more.
    n = points.shape[1]
    same = (points[:, :, None] == centres[:, None]).all(3).sum(1)  # [b, m]
    found = ball_query(points, centres, radius, min(n, slots + int(same.max())))
    distance = (gather(points, found) - centres[:, :, None]).square().sum(3)
    fresh = torch.ones_like(found, dtype=torch.bool)
    fresh[:, :, 1:] = found[:, :, 1:] != found[:, :, :1]
    member = fresh & (distance > 0)
    rank = torch.where(member, member.cumsum(2), slots + 1).clamp_max(slots + 1)
    out = index[:, :, None].repeat(1, 1, slots + 2)  # slot 0 is the centre, the last one dropped
    return out.scatter_(2, rank, torch.where(rank <= slots, found, out[:, :, :1]))[:, :, :-1]


def rscnn(
    num_classes: int,
    relation: str = "released",
    norm: str = "batch",
    dropout: float = 0.5,
) -> PointClassifier:
    """RS-CNN with its class head (512, 256; ReLU)."""
    backbone = RSCNN(relation=relation, norm=norm)
    head = ClassHead(
        backbone.feature_dim,
        num_classes,
        dropout=dropout,
        negative_slope=0.0,
        hidden_bias=False,
        norm=norm,
    )
    return PointClassifier(backbone, head)
