"""Nets in small that every method takes."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.models.base import Backbone, ClassHead, Features, PointClassifier
from qs3.models.pointdan import NodeModule, Nodes, TwoHeads
from qs3.models.pointnet import PointMLP

CLASSES = 4


class TinyBackbone(Backbone):
    """A small PointNet without T-Nets: 32 features a point, 64 a cloud.

    Args:
        norm: whether it has batch norm. Without, what the domains differ by reaches the features.
    """

    feature_dim = 64

    def __init__(self, norm: bool = True) -> None:
        super().__init__()
        self.first: nn.Module = nn.Sequential(nn.Linear(3, 32), nn.ReLU())
        self.last: nn.Module = nn.Sequential(nn.Linear(32, 64), nn.ReLU())
        if norm:
            self.first, self.last = PointMLP(3, 32), PointMLP(32, 64)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        per_point = self.first(points)
        return Features(self.last(per_point).amax(1), per_point)


def tiny_net(seed: int = 0, classes: int = CLASSES, norm: bool = True) -> PointClassifier:
    """A `TinyBackbone` with a head of one layer, or with one hidden layer with batch norm."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        backbone = TinyBackbone(norm)
        hidden = (32,) if norm else ()
        head = ClassHead(backbone.feature_dim, classes, hidden=hidden, dropout=0.0)
        return PointClassifier(backbone, head)


class TinyNodes(Backbone):
    """PointDAN's generator in small, without T-Nets and batch norm but for its nodes'."""

    feature_dim = 64

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Linear(3, 16), nn.ReLU())
        self.node_module = NodeModule(16, nodes=8, neighbours=16, radius=0.4)
        self.last = nn.Sequential(nn.Linear(32, 64), nn.ReLU())

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        return self.with_nodes(points)[0]

    def with_nodes(self, points: Float[Tensor, "b n 3"]) -> tuple[Features, Nodes]:
        nodes = self.node_module(points, self.first(points))
        return Features(self.last(nodes.points).amax(1), nodes.points), nodes


def tiny_pointdan(seed: int = 0, classes: int = CLASSES) -> PointClassifier:
    """`TinyNodes` with two classifiers."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PointClassifier(TinyNodes(), TwoHeads(TinyNodes.feature_dim, classes))
