"""Clouds a second of every net of conf/model, training and inference, beside published ones.

Published are those of PointNeXt's model zoo (Qian et al., NeurIPS 2022; inference, V100, batches of
128 x 1,024). They are of another machine, and of the layers written straight: they say what a net
costs beside the others.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch.nn import functional as F

from qs3.models.base import PointClassifier
from tests.benchmarks.device import DEVICE, WHERE, finish
from tests.benchmarks.test_simpleview_speed import boxes
from tests.models.test_all_nets import NETS, build

PUBLISHED = {"pointnet": 4212, "pointnet2_ssg": 1872, "dgcnn": 402}  # clouds a second
BATCH, POINTS, ROUNDS = 32, 1024, 3


def _net(name: str) -> PointClassifier:
    return build(name).float()


def _training(net: PointClassifier, points: torch.Tensor) -> Callable[[], None]:
    net.train()
    labels = torch.arange(len(points), device=points.device) % 5

    def step() -> None:
        net.zero_grad()
        F.cross_entropy(net(points), labels).backward()

    return step


def _inference(net: PointClassifier, points: torch.Tensor) -> Callable[[], None]:
    net.eval()

    def step() -> None:
        with torch.inference_mode():
            net(points)

    return step


def _seconds(step: Callable[[], None]) -> float:
    """The best of some rounds, after one to warm up."""
    best = float("inf")
    for turn in range(1 + ROUNDS):
        begin = time.perf_counter()
        step()
        finish()
        if turn:
            best = min(best, time.perf_counter() - begin)
    return best


def test_clouds_a_second(benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    """The benchmark's own time is that of PointNet's inference."""
    if not benchmark.enabled:
        for name in NETS:  # the table can be made of each
            assert _net(name)
        benchmark(_inference(_net("pointnet"), boxes(2, 64)))
        return
    points = boxes(BATCH, POINTS).to(DEVICE)
    benchmark.pedantic(_inference(_net("pointnet").to(DEVICE), points), rounds=3, warmup_rounds=1)
    rows = [f"\n{BATCH} x {POINTS}, {WHERE}", "| net | training | inference | published, V100 |"]
    rows.append("|---|---|---|---|")
    for name in NETS:
        net = _net(name).to(DEVICE)
        training = BATCH / _seconds(_training(net, points))
        inference = BATCH / _seconds(_inference(net, points))
        benchmark.extra_info[name] = {"training": training, "inference": inference}
        published = f"{PUBLISHED[name]:,}" if name in PUBLISHED else "-"
        rows.append(f"| {name} | {training:,.1f} | {inference:,.1f} | {published} |")
    with capsys.disabled():
        print("\n".join(rows))  # noqa: T201
