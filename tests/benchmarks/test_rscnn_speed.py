"""RS-CNN on unique pairs against the straight network, forward and backward, in one process."""

from __future__ import annotations

import time

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import nn
from torch.nn import functional as F

from qs3.models.rscnn import rscnn
from tests.benchmarks.device import DEVICE, WHERE, finish
from tests.benchmarks.test_simpleview_speed import boxes
from tests.models.reference_rscnn import NaiveRSCNN


@pytest.mark.parametrize("relation", ["released", "original"])
def test_training_step(
    relation: str, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    torch.manual_seed(0)
    b = 16 if benchmark.enabled else 2
    model = rscnn(10, relation=relation).to(DEVICE)
    points, labels = boxes(b).to(DEVICE), torch.arange(b, device=DEVICE) % 10

    def step(net: nn.Module) -> None:
        net.zero_grad()
        F.cross_entropy(net(points), labels).backward()
        finish()

    benchmark.pedantic(step, (model,), rounds=5, warmup_rounds=1)
    if not benchmark.enabled:
        return
    naive, theirs = NaiveRSCNN(model), torch.inf
    for _ in range(4):
        begin = time.perf_counter()
        step(naive)
        theirs = min(theirs, (time.perf_counter() - begin) / b)
    ours = benchmark.stats.stats.min / b
    benchmark.extra_info["ms_per_cloud"] = ours * 1e3
    benchmark.extra_info["times_faster"] = theirs / ours
    with capsys.disabled():
        print(  # noqa: T201
            f"\nRS-CNN {relation} {b} x 1024: {ours * 1e3:.1f} ms a cloud, straight "
            f"{theirs * 1e3:.1f}: {theirs / ours:.1f} times faster, "
            f"{WHERE}"
        )
