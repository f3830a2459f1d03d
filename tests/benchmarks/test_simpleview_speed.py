"""SimpleView against its released sequence of operations, forward and backward, in one process."""

from __future__ import annotations

import time

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import nn
from torch.nn import functional as F

from qs3.models.simpleview import simpleview
from tests.benchmarks.device import DEVICE, WHERE, finish
from tests.models.reference_simpleview import NaiveSimpleView


def boxes(b: int, n: int = 1024, seed: int = 0) -> torch.Tensor:
    """Points on the surfaces of boxes of many shapes, in the unit ball: [b, n, 3].

    They fill more of their images than ModelNet10's objects: windows about them cover a half of
    the images, about those 0.4.
    """
    generator = torch.Generator().manual_seed(seed)
    points = 2 * torch.rand(b, n, 3, generator=generator) - 1
    side = torch.randint(3, (b, n, 1), generator=generator)
    points = points.scatter(2, side, points.gather(2, side).sign())
    points = points * (0.2 + torch.rand(b, 1, 3, generator=generator))
    return points / points.norm(dim=2).amax(1)[:, None, None]


@pytest.mark.parametrize("training", [True, False])
def test_step(training: bool, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    torch.manual_seed(0)
    b = 18 if benchmark.enabled else 2  # as published
    model = simpleview(10).train(training).to(DEVICE)
    labels = torch.arange(b, device=DEVICE) % 10
    # each round other clouds, and so other sizes of windows, the same for both sides
    rounds = iter(boxes(b, seed=seed).to(DEVICE) for seed in range(20))

    def step(net: nn.Module, points: torch.Tensor) -> None:
        if not training:
            with torch.no_grad():
                net(points)
        else:
            net.zero_grad()
            F.cross_entropy(net(points), labels).backward()
        finish()

    benchmark.pedantic(step, setup=lambda: ((model, next(rounds)), {}), rounds=6, warmup_rounds=1)
    if not benchmark.enabled:
        return
    naive, theirs = NaiveSimpleView(model).train(training), torch.inf
    for seed in range(7):
        points = boxes(b, seed=seed).to(DEVICE)
        begin = time.perf_counter()
        step(naive, points)
        if seed:  # after a warm-up
            theirs = min(theirs, (time.perf_counter() - begin) / b)
    ours = benchmark.stats.stats.min / b
    benchmark.extra_info["ms_per_cloud"] = ours * 1e3
    benchmark.extra_info["times_faster"] = theirs / ours
    with capsys.disabled():
        print(  # noqa: T201
            f"\nSimpleView {'training' if training else 'inference'} {b} x 1024: "
            f"{ours * 1e3:.1f} ms a cloud, straight {theirs * 1e3:.1f}: "
            f"{theirs / ours:.2f} times faster, {WHERE}"
        )
