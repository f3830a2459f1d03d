"""Box shapes, shifts between domains, and a net that learns them in seconds."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.methods.base import Method
from qs3.models.base import Backbone, ClassHead, Features, PointClassifier
from qs3.models.pointdan import NodeModule, Nodes, TwoHeads
from qs3.models.pointnet import PointMLP

# Sizes of two boxes, one on the other: a table, a chair's seat and back, ...
_LOWER = torch.tensor([[1.0, 0.6, 0.1], [0.5, 0.5, 0.5], [0.3, 0.3, 1.0], [1.0, 0.5, 0.5]])
_UPPER = torch.tensor([[0.1, 0.1, 0.9], [0.5, 0.1, 0.5], [0.8, 0.8, 0.1], [0.3, 0.5, 0.4]])
CLASSES = len(_LOWER)


def boxes(
    labels: Int[Tensor, " b"], n: int, generator: torch.Generator, vary: float = 0.25
) -> Float[Tensor, "b n 3"]:
    """Points on the faces of two boxes a cloud, in the unit ball about their mean."""
    b = len(labels)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    lower = _LOWER[labels] * (1 + vary * (2 * uniform(b, 3) - 1))
    upper = _UPPER[labels] * (1 + vary * (2 * uniform(b, 3) - 1))
    half = (uniform(b, n, 1) < 0.5).expand(-1, -1, 3)
    cube = 2 * uniform(b, n, 3) - 1
    axis = torch.randint(3, (b, n, 1), generator=generator)
    cube = cube.scatter(2, axis, cube.gather(2, axis).sign())  # onto a face
    raise_ = torch.stack([torch.zeros(b), torch.zeros(b), lower[:, 2] + upper[:, 2]], 1)
    points = torch.where(half, cube * lower[:, None], cube * upper[:, None] + raise_[:, None])
    return unit_ball(points)


def unit_ball(points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
    """Centred, the farthest point at distance 1."""
    points = points - points.mean(1, keepdim=True)
    return points / points.norm(dim=2).amax(1)[:, None, None]


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


def train(
    method: Method,
    net: nn.Module,
    source: tuple[Tensor, Tensor],
    target: Tensor,
    *,
    steps: int,
    seed: int,
    batch_size: int = 32,
    lr: float = 3e-3,
    beside: tuple[dict[str, Tensor], dict[str, Tensor]] = ({}, {}),
) -> None:
    """Adam on the method's loss, learning rate along half a cosine; all from `seed`.

    `beside`: of the source and of the target, further clouds by their key in a batch.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        method.prepare(net)
        generator = torch.Generator().manual_seed(seed)
        parameters = [*net.parameters(), *method.parameters()]
        optimizer = torch.optim.Adam(parameters, lr)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        net.train()
        for step in range(steps):
            own = torch.randint(len(source[0]), (batch_size,), generator=generator)
            other = torch.randint(len(target), (batch_size,), generator=generator)
            batch: dict[str, Any] = {
                "source": {
                    "points": source[0][own],
                    "y_source": source[1][own],
                    **{key: clouds[own] for key, clouds in beside[0].items()},
                },
                "target": {
                    "points": target[other],
                    **{key: clouds[other] for key, clouds in beside[1].items()},
                },
                "progress": (step + 1) / steps,
            }
            loss = torch.stack(list(method.loss(net, batch, generator).values())).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()


@torch.no_grad()
def accuracy(net: nn.Module, points: Tensor, labels: Tensor) -> float:
    """In eval mode."""
    net.eval()
    return float((net(points).argmax(1) == labels).double().mean())
