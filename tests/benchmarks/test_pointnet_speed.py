"""PointNet against its straight sequence of operations, forward and backward, in one process."""

from __future__ import annotations

import time

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import nn
from torch.nn import functional as F

from qs3.models.pointnet import pointnet
from tests.benchmarks.device import DEVICE, WHERE, finish
from tests.benchmarks.test_simpleview_speed import boxes
from tests.models.reference_pointnet import NaivePointNet


def test_training_step(benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    torch.manual_seed(0)
    b = 16 if benchmark.enabled else 2
    model = pointnet(10).to(DEVICE)
    points, labels = boxes(b).to(DEVICE), torch.arange(b, device=DEVICE) % 10

    def step(net: nn.Module) -> None:
        net.zero_grad()
        F.cross_entropy(net(points), labels).backward()
        finish()

    benchmark.pedantic(step, (model,), rounds=6, warmup_rounds=1)
    if not benchmark.enabled:
        return
    naive, theirs = NaivePointNet(model), torch.inf
    for turn in range(7):
        begin = time.perf_counter()
        step(naive)
        if turn:  # after a warm-up
            theirs = min(theirs, (time.perf_counter() - begin) / b)
    ours = benchmark.stats.stats.min / b
    benchmark.extra_info["ms_per_cloud"] = ours * 1e3
    benchmark.extra_info["times_faster"] = theirs / ours
    with capsys.disabled():
        print(  # noqa: T201
            f"\nPointNet {b} x 1024: {ours * 1e3:.1f} ms a cloud, straight {theirs * 1e3:.1f}: "
            f"{theirs / ours:.1f} times faster, {WHERE}"
        )
