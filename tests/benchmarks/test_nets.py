"""Nets and methods: steps against the formulas of the layers as published, in one process.

The figures of docs/reference/backbones.md.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import nn
from torch.nn import functional as F

from qs3.engine.cuda_graphs import EAGER, Graphs
from qs3.geometry.neighbours import farthest_point_sampling
from qs3.kernels import plain
from qs3.methods.bounds import SourceOnly
from tests.benchmarks.timing import (
    DEVICE,
    ENABLED,
    POINTS,
    WHERE,
    Pair,
    Step,
    compare,
    finish,
    seconds,
    show,
)
from tests.methods.cases import CASES, Case, batch_of, total
from tests.models.test_all_nets import NETS, build

PUBLISHED = {"pointnet": 4212, "dgcnn": 402}  # clouds a second: PointNeXt's model zoo, V100
on_gpu = pytest.mark.skipif(DEVICE.type != "cuda", reason="needs DEVICE=cuda")


def boxes(b: int, n: int = 1024) -> torch.Tensor:
    """Points on the surfaces of boxes of many shapes, in the unit ball: [b, n, 3]."""
    generator = torch.Generator().manual_seed(0)
    points = 2 * torch.rand(b, n, 3, generator=generator) - 1
    side = torch.randint(3, (b, n, 1), generator=generator)
    points = points.scatter(2, side, points.gather(2, side).sign())
    points = points * (0.2 + torch.rand(b, 1, 3, generator=generator))
    return points / points.norm(dim=2).amax(1)[:, None, None]


def net_step(net: nn.Module, points: torch.Tensor, training: bool = True) -> Step:
    """Forward and backward; or forward alone, in eval mode."""
    net.train(training)
    labels = torch.arange(len(points), device=points.device) % 5

    def train() -> None:
        net.zero_grad()
        F.cross_entropy(net(points), labels).backward()

    def infer() -> None:
        with torch.inference_mode():
            net(points)

    return train if training else infer


def by_formula(step: Step) -> Step:
    """The same step without our kernels."""

    def run() -> None:
        with plain():
            step()

    return run


def of_net(name: str, b: int, n: int, some: int, training: bool = True, **settings: Any) -> Pair:
    """The formulas take `some` clouds on the CPU, as many as their memory likes."""
    net = build(name, **settings).float().to(DEVICE)
    b, n = (b, n) if ENABLED else (2, 64)
    points = boxes(b, n).to(DEVICE)
    few = points[:some] if DEVICE.type == "cpu" else points
    ours, theirs = net_step(net, points, training), by_formula(net_step(net, few, training))
    return Pair(ours, theirs, "by formula", (b, len(few)))


def released_fps(points: np.ndarray, count: int, start: int = 0) -> np.ndarray:
    """Farthest point sampling as the released loaders loop it in numpy."""
    distance = np.full(len(points), 1e10)
    chosen = np.zeros(count, dtype=np.int64)
    for i in range(count):
        chosen[i] = start
        distance = np.minimum(distance, np.sum((points - points[start]) ** 2, -1))
        start = int(np.argmax(distance))
    return chosen


def of_sampling() -> Pair:
    points = boxes(16, 2048).to(DEVICE)
    cloud = points[0].cpu().numpy()
    return Pair(
        lambda: farthest_point_sampling(points, 1024),
        lambda: released_fps(cloud, 1024),
        "numpy loop",
        (16, 1),
    )


PAIRS: dict[str, Callable[[], Pair]] = {
    "DGCNN uda 16 x 1024": lambda: of_net("dgcnn", 16, 1024, 2),
    "DGCNN simpleview 16 x 1024": lambda: of_net("dgcnn", 16, 1024, 2, variant="simpleview"),
    "PointNet 16 x 1024": lambda: of_net("pointnet", 16, 1024, 16),
    "PointNet++ ssg 16 x 1024": lambda: of_net("pointnet2", 16, 1024, 4, variant="ssg"),
    "PointNet++ msg 16 x 1024": lambda: of_net("pointnet2", 16, 1024, 4),
    "RS-CNN released 16 x 1024": lambda: of_net("rscnn", 16, 1024, 16),
    "SimpleView training 18 x 1024": lambda: of_net("simpleview", 18, 1024, 18),
    "SimpleView inference 18 x 1024": lambda: of_net("simpleview", 18, 1024, 18, training=False),
    "FPS 2048 -> 1024": of_sampling,
}


@pytest.mark.parametrize("name", PAIRS)
def test_pair(name: str, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    torch.manual_seed(0)
    compare(name, PAIRS[name](), benchmark, capsys)


def test_methods(capsys: pytest.CaptureFixture) -> None:
    """A step of each method relative to source only of the same net, in turns.

    In seconds of this process: others on a busy machine take time from both.
    """
    clock = time.process_time if DEVICE.type == "cpu" else time.perf_counter

    def step(case: Case, net: Any) -> Step:
        torch.manual_seed(0)
        method, net = case.make(), net.float().train().to(DEVICE)
        method.prepare(net)
        method = method.to(DEVICE)
        b, n = (16, POINTS) if ENABLED else (2, 64)
        batch = batch_of(case, method, b, n, 5, DEVICE.type)
        generator = torch.Generator(DEVICE).manual_seed(0)
        return lambda: total(method, net, batch, generator).backward()

    found = []
    for name, case in CASES.items():
        net = "pointdan" if name == "pointdan" else "dgcnn"
        ours = seconds(step(case, build(net)), 3 if ENABLED else 1, clock)
        plain = seconds(step(Case(SourceOnly, 1), build(net)), 3 if ENABLED else 1, clock)
        found.append((ours / plain, ours, name, net, case.passes))
    if ENABLED:
        assert all(ratio <= 2 * passes for ratio, *_, passes in found)
        rows = [f"16 x {POINTS}, {WHERE}", "| method | net | ms | times source only | passes |"]
        rows += ["|---|---|---|---|---|"]
        rows += [
            f"| {m} | {n} | {1e3 * s:.0f} | {r:.2f} | {p} |" for r, s, m, n, p in sorted(found)
        ]
        show(capsys, *rows)


def test_clouds_a_second(capsys: pytest.CaptureFixture) -> None:
    b = 32 if ENABLED else 2
    points = boxes(b, 1024 if ENABLED else 64).to(DEVICE)
    rows = [f"{b} x 1024, {WHERE}", "| net | training | inference | published, V100 |"]
    rows.append("|---|---|---|---|")
    for name in NETS:
        net = build(name).float().to(DEVICE)
        found = [
            b / seconds(net_step(net, points, way), 3 if ENABLED else 1) for way in (True, False)
        ]
        rows.append(f"| {name} | {found[0]:,.1f} | {found[1]:,.1f} | {PUBLISHED.get(name, '-')} |")
    if ENABLED:
        show(capsys, *rows)


def _graph_step(net: Any, points: torch.Tensor) -> Step:
    """With the CUDA graphs that trainings have, captured."""
    made, labels = Graphs(net), torch.arange(len(points), device=points.device) % 5

    def step() -> None:
        made.begin_step()
        net.zero_grad()
        F.cross_entropy(made.stand_in(points), labels).backward()

    for _ in range(EAGER):
        step()
    return step


@on_gpu
def test_steps_with_graphs(capsys: pytest.CaptureFixture) -> None:
    rows = [
        "| net | clouds | ms | graphs, ms | by formula, ms | times faster | GB |",
        "|---" * 7 + "|",
    ]
    for name in NETS:
        for b, n in ((16, 256), (16, 1024), (64, 1024)):
            points = boxes(b, n).to(DEVICE)
            net = build(name).float().train().to(DEVICE)
            ours = 1e3 * seconds(net_step(net, points), 20)
            graphs = 1e3 * seconds(_graph_step(net, points), 20)
            torch.cuda.reset_peak_memory_stats()
            net_step(net, points)()
            finish()
            shown = f"| {name} | {b} x {n} | {ours:.2f} | {graphs:.2f} |"
            peak = torch.cuda.max_memory_allocated() / 1e9
            theirs = 1e3 * seconds(by_formula(net_step(net, points)), 20)
            rows.append(f"{shown} {theirs:.2f} | {theirs / graphs:.1f} | {peak:.2f} |")
    show(capsys, WHERE, *rows)
