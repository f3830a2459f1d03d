"""Several nets that learn apart and answer together.

Nets of different kinds err in different places: on real objects a net of neighbours (DGCNN) and one
of pictures (`frontview`) are right more often together than either alone. (Ours.)
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.kernels.norms import Norm
from qs3.models.base import Backbone, Features, PointClassifier
from qs3.models.dgcnn import dgcnn
from qs3.models.frontview import frontview
from qs3.utils.settings import checked


class SideBySide(Backbone):
    """Features of all backbones, one after the other; a point has none."""

    def __init__(self, backbones: Sequence[Backbone]) -> None:
        super().__init__()
        self.each = nn.ModuleList(backbones)
        self.least_points = max(one.least_points for one in backbones)
        self.feature_dim = sum(one.feature_dim for one in backbones)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """[B, N, 3] to [B, D]."""
        return Features(torch.cat([one(points).global_ for one in self.each], dim=1), None)


class Vote(nn.Module):
    """Logarithms of the mean of the heads' probabilities, each of its own backbone's features."""

    def __init__(self, heads: Sequence[nn.Module], dims: Sequence[int]) -> None:
        super().__init__()
        self.each, self.dims = nn.ModuleList(heads), tuple(dims)

    def forward(self, features: Float[Tensor, "b d"]) -> Float[Tensor, "b c"]:
        """Logits."""
        parts = zip(self.each, features.split(self.dims, dim=1), strict=True)
        votes = torch.stack([head(part).log_softmax(dim=1) for head, part in parts])
        return votes.logsumexp(dim=0) - math.log(len(self.each))


class Committee(PointClassifier):
    """In training each member learns from a part of the batch of its own, as if it were alone."""

    backbone: SideBySide
    head: Vote

    def __init__(self, members: Sequence[PointClassifier]) -> None:
        backbones = [one.backbone for one in members]
        heads, dims = [one.head for one in members], [one.feature_dim for one in backbones]
        super().__init__(SideBySide(backbones), Vote(heads, dims))

    def forward(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b c"]:
        """Logits; in training each cloud's are of one member, where each has at least two."""
        if not self.training or len(points) < 2 * len(self.backbone.each):
            return super().forward(points)
        nets = zip(self.backbone.each, self.head.each, strict=True)
        parts = points.tensor_split(len(self.backbone.each))
        logits = [head(net(part).global_) for (net, head), part in zip(nets, parts, strict=True)]
        return torch.cat(logits)


@checked
def committee(num_classes: int, norm: Norm = "batch") -> Committee:
    """DGCNN and `frontview`, each as conf/model has it."""
    return Committee([dgcnn(num_classes, norm=norm), frontview(num_classes, norm=norm)])
