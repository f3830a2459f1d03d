"""DGCNN without edges against the straight network, forward and backward, in one process."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import nn
from torch.nn import functional as F

from qs3.models.dgcnn import dgcnn
from tests.models.reference import NaiveDGCNN


def _step(model: nn.Module, points: torch.Tensor, labels: torch.Tensor) -> Callable[[], None]:
    def step() -> None:
        model.zero_grad()
        F.cross_entropy(model(points), labels).backward()

    return step


@pytest.mark.parametrize(("b", "n", "k"), [(16, 1024, 20), (32, 256, 20), (32, 256, 10)])
def test_training_step(
    b: int, n: int, k: int, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    torch.manual_seed(0)
    model = dgcnn(10, k=k)
    points, labels = torch.randn(b, n, 3) / 2, torch.randint(10, (b,))
    step = _step(model, points, labels)
    benchmark.pedantic(step, rounds=4, warmup_rounds=1)
    if not benchmark.enabled:
        return
    naive = _step(NaiveDGCNN(model), points[:2], labels[:2])  # as many as memory likes
    naive()
    begin = time.perf_counter()
    naive()
    theirs = (time.perf_counter() - begin) / 2
    ours = benchmark.stats.stats.min / b
    benchmark.extra_info["ms_per_cloud"] = ours * 1e3
    benchmark.extra_info["times_faster"] = theirs / ours
    with capsys.disabled():
        print(  # noqa: T201
            f"\nDGCNN {b} x {n}, k {k}: {ours * 1e3:.1f} ms a cloud, naive {theirs * 1e3:.1f}: "
            f"{theirs / ours:.1f} times faster, {torch.get_num_threads()} threads"
        )
