"""Each idea at work: on a shift where it should help, a method beats its copy without it.

Net, data, steps and random draws are the same; only the weight of the loss is 0 in the copy.
"""

from __future__ import annotations

import math

import pytest
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.methods.bounds import SourceOnly
from qs3.methods.dann import Dann
from qs3.methods.pcm import Pcm
from qs3.models.base import Backbone, Features, PointClassifier
from tests.methods.shapes import CLASSES, accuracy, boxes, tiny_net, train

POINTS = 64


def clutter(points: Tensor, generator: torch.Generator) -> Tensor:
    """A third of each cloud's points are those of another one."""
    b, n, _ = points.shape
    other = points[torch.randperm(b, generator=generator)]
    order = torch.randperm(n, generator=generator)
    own, foreign = order[n // 3 :], order[: n // 3]
    return torch.cat([points[:, own], other[:, foreign]], dim=1)


def aside(points: Tensor, generator: torch.Generator) -> Tensor:
    """All clouds moved by 1 along x: the target is not where the source is."""
    return points + torch.tensor([1.0, 0.0, 0.0])


def strays(points: Tensor, generator: torch.Generator) -> Tensor:
    """A tenth of the points lie anywhere in [-1, 1]^3."""
    b, n, _ = points.shape
    anywhere = torch.rand(b, n // 10, 3, generator=generator) * 2 - 1
    return torch.cat([points[:, n // 10 :], anywhere], dim=1)


@pytest.mark.slow
def test_pcm_withstands_clutter() -> None:
    """A net that has learned to name both parts of a mixture is not led astray by a third."""
    gains = []
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        y_source = torch.arange(256) % CLASSES
        source = boxes(y_source, POINTS, generator)
        labels = [torch.randint(CLASSES, (256,), generator=generator) for _ in range(2)]
        target, held_out = (clutter(boxes(y, POINTS, generator), generator) for y in labels)
        found = []
        for method in (Pcm(), SourceOnly()):
            net = tiny_net(seed)
            train(method, net, (source, y_source), target, steps=150, seed=seed, batch_size=16)
            found.append(accuracy(net, held_out, labels[1]))
        gains.append(found[0] - found[1])
    assert sum(gains) / 3 > 0.05, gains


def moons(labels: Int[Tensor, " b"], generator: torch.Generator) -> Float[Tensor, "b 1 3"]:
    """A cloud is one point of its class's half circle, with noise of 0.1, at z = 0."""
    t = math.pi * torch.rand(len(labels), generator=generator)
    upper, lower = torch.stack([t.cos(), t.sin()], 1), torch.stack([1 - t.cos(), 0.5 - t.sin()], 1)
    points = torch.where(labels[:, None] == 0, upper, lower) - torch.tensor([0.5, 0.25])
    points = points + 0.1 * torch.randn(points.shape, generator=generator)
    return nn.functional.pad(points, (0, 1))[:, None]


class OneLayer(Backbone):
    """100 features of a cloud."""

    feature_dim = 100

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, self.feature_dim)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        return Features(self.layer(points).relu().amax(1), None)


@pytest.mark.slow
def test_dann_follows_the_turned_moons() -> None:
    """Its paper's problem (JMLR 2016, 5.1): the loss is worth 0.1 or more on average."""
    c, s = math.cos(math.radians(35)), math.sin(math.radians(35))
    turn = torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    gains = []
    for seed in range(4):
        generator = torch.Generator().manual_seed(seed)
        labels = torch.arange(300) % 2
        source, target = moons(labels, generator), moons(labels, generator) @ turn
        held_out = torch.randint(2, (600,), generator=generator)
        test = moons(held_out, generator) @ turn
        found = {}
        for weight in (1.0, 0.0):
            torch.manual_seed(seed)
            net = PointClassifier(OneLayer(), nn.Linear(OneLayer.feature_dim, 2))
            schedule = {"steps": 1500, "seed": seed, "batch_size": 64, "lr": 1e-2}
            train(Dann(domain_weight=weight), net, (source, labels), target, **schedule)
            found[weight] = accuracy(net, test, held_out)
        gains.append(found[1.0] - found[0.0])
    assert sum(gains) / len(gains) > 0.08, gains
