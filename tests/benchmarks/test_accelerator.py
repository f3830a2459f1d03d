"""Every net against the straight one of its authors' operations, a training step of equal batches.

The figures of docs/reference/accelerators.md; on the CPU each net has a file of its own, with
baselines that fit its memory.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import Any, Literal

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import nn
from torch.nn import functional as F

from qs3.engine.cuda_graphs import EAGER, Graphs
from qs3.models.base import PointClassifier
from tests.benchmarks.device import DEVICE, WHERE, deterministic, finish
from tests.benchmarks.test_kernels import STRAIGHT
from tests.benchmarks.test_simpleview_speed import boxes
from tests.models.test_all_nets import NETS, build

ROUNDS, WARMUP, SECONDS, TURNS = 30, 5, 4.0, 2
SIZES = ((16, 256), (16, 1024), (64, 1024))
DETERMINISTIC: dict[str, Literal["warn", False]] = {"warn": "warn", "off": False}


def _or_nan(measured: Callable[[], float]) -> float:
    """NaN if the memory is too small."""
    try:
        return measured()
    except torch.OutOfMemoryError:
        return float("nan")


def _milliseconds(net: nn.Module, points: torch.Tensor, graphs: bool = False) -> float:
    """The median of some steps, forward and backward; NaN if the memory is too small."""
    labels = torch.arange(len(points), device=points.device) % 5
    assert isinstance(net, PointClassifier) or not graphs
    made: Any = Graphs(net) if graphs else None
    passes: Any = made.stand_in if graphs else net

    def step() -> None:
        if graphs:
            made.begin_step()
        net.zero_grad()
        F.cross_entropy(passes(points), labels).backward()
        finish()

    def measured() -> float:
        for _ in range(EAGER if graphs else 0):  # then it is captured, in what warms up
            step()
        return _median_ms(step)

    return _or_nan(measured)


def _median_ms(step: Callable[[], None]) -> float:
    times: list[float] = []
    end = float("inf")
    for turn in range(WARMUP + ROUNDS):
        begin = time.perf_counter()
        step()
        if turn >= WARMUP:
            times.append(time.perf_counter() - begin)
        if turn == 0:
            end = begin + SECONDS  # slow ones are seen less often
        elif turn >= WARMUP + 2 and time.perf_counter() > end:
            break
    return 1e3 * median(times)


def _peak_gb(net: nn.Module, points: torch.Tensor) -> float:
    """The most memory of a step; NaN likewise."""
    labels = torch.arange(len(points), device=DEVICE) % 5

    def peak() -> float:
        torch.cuda.reset_peak_memory_stats()
        F.cross_entropy(net(points), labels).backward()
        return torch.cuda.max_memory_allocated() / 1e9

    return _or_nan(peak)


def test_steps(benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    """The benchmark's own time is that of PointNet."""
    small = boxes(16, 256)[:, :, :3].to(DEVICE)
    net = build("pointnet").float().train().to(DEVICE)
    benchmark.pedantic(_milliseconds, (net, small[:2, :64]), rounds=1)
    if not benchmark.enabled or DEVICE.type != "cuda":
        assert set(STRAIGHT) <= set(NETS)
        return
    rows = [f"\n{WHERE}, torch {torch.__version__}: ms a step, forward and backward"]
    rows += ["| net | clouds | ms | graphs, ms | straight, ms | times faster | GB | straight, GB |"]
    rows += ["|---|---|---|---|---|---|---|---|"]
    for name in NETS:
        for b, n in SIZES:
            points = boxes(b, n).to(DEVICE)
            net = build(name).float().train().to(DEVICE)
            ours, memory = _milliseconds(net, points), _peak_gb(net, points)
            graphs = _milliseconds(net, points, graphs=True)
            shown = f"| {name} | {b} x {n} | {ours:.2f} | {graphs:.2f} |"
            if name in STRAIGHT:
                straight = STRAIGHT[name](build(name).float()).train().to(DEVICE)
                theirs = _milliseconds(straight, points)
                if name == "dgcnn" and n == 1024:
                    assert theirs >= 2 * graphs
                benchmark.extra_info[f"{name} {b} x {n}"] = theirs / graphs
                shown += f" {theirs:.2f} | {theirs / graphs:.1f} | {memory:.2f} |"
                shown += f" {_peak_gb(straight, points):.2f} |"
            else:
                shown += f" - | - | {memory:.2f} | - |"
            rows.append(shown)
    with capsys.disabled():
        print("\n".join(rows))  # noqa: T201


def _named(word: str, graphs: bool) -> str:
    return f"{word}, graphs" if graphs else word


def test_what_determinism_costs(benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    """A step of DGCNN by `trainer.deterministic`; the benchmark's own time is of small clouds.

    On a GPU also with the graphs that trainings have there.
    """
    net = build("dgcnn").float().train().to(DEVICE)
    small = boxes(2, 64).to(DEVICE)
    benchmark.pedantic(_milliseconds, (net, small), rounds=1)
    sizes = ((2, 64),) if not benchmark.enabled else SIZES if DEVICE.type == "cuda" else SIZES[:1]
    ways = (False, True) if DEVICE.type == "cuda" else (False,)
    cases = [(word, graphs) for graphs in ways for word in DETERMINISTIC]
    found: dict[str, dict[str, float]] = {_named(*case): {} for case in cases}
    for _ in range(TURNS):  # others on a busy machine take time from both
        for word, graphs in cases:
            of_sizes = found[_named(word, graphs)]
            for b, n in sizes:
                with deterministic(DETERMINISTIC[word]):
                    ms = _milliseconds(net, boxes(b, n).to(DEVICE), graphs)
                of_sizes[f"{b} x {n}"] = min(ms, of_sizes.get(f"{b} x {n}", ms))
    if not benchmark.enabled:
        assert all(of_sizes["2 x 64"] > 0 for of_sizes in found.values())
        return
    benchmark.extra_info |= found
    rows = [f"\n{WHERE}, torch {torch.__version__}: ms a step of DGCNN, forward and backward"]
    rows += ["| `trainer.deterministic` |" + "".join(f" {size} |" for size in found["off"])]
    rows += ["|---|" + "---|" * len(sizes)]
    for word, of_sizes in found.items():
        rows.append(f"| {word} |" + "".join(f" {ms:.2f} |" for ms in of_sizes.values()))
    with capsys.disabled():
        print("\n".join(rows))  # noqa: T201
