"""Every net against the authors' operations written straight: the same numbers, as little rounding.

The straight networks are the baselines of `make bench`, too.
"""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.models import pointnet2
from tests.models.reference import NaiveDGCNN
from tests.models.reference_pointnet import NaivePointNet
from tests.models.reference_pointnet2 import StraightPointNet2
from tests.models.reference_rscnn import NaiveRSCNN
from tests.models.reference_simpleview import NaiveSimpleView
from tests.models.test_all_nets import build, clouds

CASES: dict[str, tuple[str, Any, dict[str, Any]]] = {
    "dgcnn": ("dgcnn", NaiveDGCNN, {"k": 5}),
    "dgcnn simpleview": ("dgcnn", NaiveDGCNN, {"k": 5, "variant": "simpleview"}),
    "dgcnn instance": ("dgcnn", NaiveDGCNN, {"k": 5, "norm": "instance"}),
    "pointnet": ("pointnet", NaivePointNet, {}),
    "pointnet2 ssg": ("pointnet2", StraightPointNet2, {"variant": "ssg"}),
    "pointnet2 msg": ("pointnet2", StraightPointNet2, {}),
    "rscnn": ("rscnn", NaiveRSCNN, {}),
    "rscnn original": ("rscnn", NaiveRSCNN, {"relation": "original"}),
    "rscnn paper": ("rscnn", NaiveRSCNN, {"relation": "paper"}),
    "simpleview": ("simpleview", NaiveSimpleView, {"image_size": 16}),
}
QUICK = {"dgcnn", "pointnet", "pointnet2 ssg", "rscnn", "simpleview"}
each = pytest.mark.parametrize(
    "case", [pytest.param(c, marks=() if c in QUICK else pytest.mark.slow) for c in CASES]
)


@pytest.fixture(autouse=True)
def _few_centres(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same layers about an eighth of the centres: written straight they are slow."""
    for name in ("SSG", "MSG"):
        levels = tuple((m // 8, scales) for m, scales in getattr(pointnet2, name))
        monkeypatch.setattr(pointnet2, name, levels)


def _made(case: str) -> nn.Module:
    """As after some training: norms with scales of both signs, and statistics of their own."""
    name, _, settings = CASES[case]
    net = build(name, dropout=0.0, **settings)
    for module in net.modules():
        if isinstance(module, nn.modules.batchnorm._NormBase):
            nn.init.normal_(module.weight, 1.0, 0.8)
            nn.init.normal_(module.bias, 0.0, 0.3)
            if module.running_mean is not None:
                module.running_mean.normal_()
                module.running_var.uniform_(0.5, 2)
    return net


def _step(net: nn.Module, points: Tensor) -> tuple[Tensor, Tensor]:
    """Logits, and the norms of all gradients, which have other shapes in a straight net."""
    logits = net(points)
    F.cross_entropy(logits, torch.arange(len(points)) % 5).backward()
    norms = [p.grad.norm() for p in net.parameters() if p.grad is not None]
    return logits.detach().double(), torch.stack(norms).double().sort().values


@each
@pytest.mark.parametrize("training", [True, False])
def test_equals_the_straight_net(case: str, training: bool) -> None:
    ours = _made(case).train(training)
    straight = CASES[case][1](copy.deepcopy(ours)).train(training)
    points = clouds(6, 150)
    (a, da), (b, db) = _step(ours, points), _step(straight, points)
    torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(da, db, rtol=1e-7, atol=1e-8 * float(db.max()))


@each
def test_float32_errs_no_more_than_twice_the_straight_net(case: str) -> None:
    """A sum over clouds: of a few, one maximum that goes elsewhere can outweigh all rounding."""
    exact = _made(case)
    ours, straight = (copy.deepcopy(exact).float() for _ in range(2))
    straight = CASES[case][1](straight)
    errors = torch.zeros(2)
    for n in range(150, 154):
        points = clouds(6, n).float()
        truth, *found = (net(points.to(kind)).detach().double() for net, kind in (
            (exact, torch.float64), (ours, torch.float32), (straight.eval(), torch.float32),
        ))  # fmt: skip
        errors += torch.tensor([(one - truth).norm() for one in found])
    assert errors[0] <= 2 * errors[1], errors
