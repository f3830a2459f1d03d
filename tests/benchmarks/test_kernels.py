"""Kernels of a training step on an accelerator, of every net and method: a table, counted anywhere.

16 clouds of 1,024 points; see `tests.device`. Methods are on DGCNN, PointDAN's on its own net. The
straight nets take the operations of their authors' code one by one, and our farthest points.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from tests.device import Watch
from tests.methods.cases import CASES, batch_of, total
from tests.models.reference import NaiveDGCNN
from tests.models.reference_pointnet import NaivePointNet
from tests.models.reference_pointnet2 import StraightPointNet2
from tests.models.reference_rscnn import NaiveRSCNN
from tests.models.reference_simpleview import NaiveSimpleView
from tests.models.test_all_nets import NETS, build

STRAIGHT: dict[str, Any] = {
    "dgcnn": NaiveDGCNN,
    "pointnet": NaivePointNet,
    "pointnet2": StraightPointNet2,
    "pointnet2_ssg": StraightPointNet2,
    "rscnn": NaiveRSCNN,
    "simpleview": NaiveSimpleView,
}
BATCH, POINTS, CLASSES = 16, 1024, 5


def _of_net(net: nn.Module) -> int:
    net = net.train().to("meta")
    points = torch.empty(BATCH, POINTS, 3, device="meta")
    labels = torch.empty(BATCH, dtype=torch.int64, device="meta")
    with Watch() as watch:
        F.cross_entropy(net(points), labels).backward()
    return watch.kernels.total()


def _of_method(name: str) -> int:
    net = build("pointdan" if name == "pointdan" else "dgcnn").float().train()
    method = CASES[name].make()
    method.prepare(net)
    net, method = net.to("meta"), method.to("meta")
    batch = batch_of(CASES[name], method, BATCH, POINTS, CLASSES, "meta")
    with Watch() as watch:
        total(method, net, batch, torch.Generator().manual_seed(0)).backward()
    return watch.kernels.total()


def test_kernels_of_a_step(request: pytest.FixtureRequest, capsys: pytest.CaptureFixture) -> None:
    if not request.config.getoption("benchmark_enable"):
        assert set(STRAIGHT) <= set(NETS)
        return
    rows = ["\n| net | kernels | straight |", "|---|---|---|"]
    for name in NETS:
        straight = STRAIGHT[name](build(name).float()) if name in STRAIGHT else None
        theirs = "-" if straight is None else f"{_of_net(straight)}"
        rows.append(f"| {name} | {_of_net(build(name).float())} | {theirs} |")
    rows += ["\n| method | kernels | passes |", "|---|---|---|"]
    rows += [f"| {name} | {_of_method(name):,} | {case.passes} |" for name, case in CASES.items()]
    with capsys.disabled():
        print("\n".join(rows))  # noqa: T201
