"""PointNet++ against the same layers on tensors of groups, forward and backward, in one process."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable

import numpy as np
import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import nn
from torch.nn import functional as F

from qs3.geometry.neighbours import farthest_point_sampling
from qs3.models.pointnet2 import pointnet2
from tests.benchmarks.device import DEVICE, WHERE, finish
from tests.models.reference_pointnet2 import StraightPointNet2


def _step(model: nn.Module, points: torch.Tensor, labels: torch.Tensor) -> Callable[[], None]:
    def step() -> None:
        model.zero_grad()
        F.cross_entropy(model(points), labels).backward()
        finish()

    return step


def _seconds(step: Callable[[], None], rounds: int) -> float:
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        step()
        times.append(time.perf_counter() - begin)
    return min(times)


@pytest.mark.parametrize("variant", ["ssg", "msg"])
def test_training_step(
    variant: str, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    torch.manual_seed(0)
    n = 1024 if benchmark.enabled else 128
    model = pointnet2(10, variant).to(DEVICE)
    points = F.normalize(torch.randn(16, n, 3), dim=2).to(DEVICE)
    labels = torch.randint(10, (16,)).to(DEVICE)
    benchmark.pedantic(_step(model, points, labels), rounds=3, warmup_rounds=1)
    if not benchmark.enabled:
        return
    straight = _step(StraightPointNet2(copy.deepcopy(model)), points[:4], labels[:4])
    straight()
    theirs, ours = _seconds(straight, 3) / 4, benchmark.stats.stats.min / 16
    benchmark.extra_info["ms_per_cloud"] = ours * 1e3
    benchmark.extra_info["times_faster"] = theirs / ours
    with capsys.disabled():
        print(  # noqa: T201
            f"\nPointNet++ {variant} 16 x {n}: {ours * 1e3:.1f} ms a cloud, straight "
            f"{theirs * 1e3:.1f}: {theirs / ours:.1f} times faster, "
            f"{WHERE}"
        )


def released_fps(points: np.ndarray, count: int, start: int) -> np.ndarray:
    """Farthest point sampling as the released loaders loop it in numpy."""
    distance = np.full(len(points), 1e10)
    chosen = np.zeros(count, dtype=np.int64)
    farthest = start
    for i in range(count):
        chosen[i] = farthest
        square = np.sum((points - points[farthest]) ** 2, -1)
        closer = square < distance
        distance[closer] = square[closer]
        farthest = np.argmax(distance, -1)
    return chosen


def test_farthest_point_sampling(
    benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    points = F.normalize(torch.randn(16, 2048, 3), dim=2).to(DEVICE)

    def sample() -> torch.Tensor:
        found = farthest_point_sampling(points, 1024)
        finish()
        return found

    found = benchmark.pedantic(sample, rounds=5, warmup_rounds=1)
    if not benchmark.enabled:
        return
    cloud = points[0].cpu().numpy()
    assert (released_fps(cloud, 1024, 0) == found[0].cpu().numpy()).mean() > 0.99
    theirs = _seconds(lambda: released_fps(cloud, 1024, 0), 3)
    ours = benchmark.stats.stats.min / 16
    with capsys.disabled():
        print(  # noqa: T201
            f"\nFPS 2048 -> 1024: {ours * 1e3:.2f} ms a cloud, numpy loop {theirs * 1e3:.1f}: "
            f"{theirs / ours:.0f} times faster, {WHERE}"
        )
