"""How and where benchmarks run: `make bench DEVICE=cuda` for nets and methods, or `THREADS=1`.

And of how many points the clouds of the methods' steps are: `POINTS=512`.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture

from qs3.utils.processor import cores

ENABLED = "--benchmark-enable" in sys.argv  # else everything runs once, small
THREADS = int(os.environ.get("QS3_BENCH_THREADS") or len(cores()))  # as a training takes them
POINTS = int(os.environ.get("QS3_BENCH_POINTS") or 1024)
DEVICE = torch.device(os.environ.get("QS3_BENCH_DEVICE") or "cpu")
WHERE = f"{THREADS} threads" if DEVICE.type == "cpu" else torch.cuda.get_device_name(DEVICE)
Step = Callable[[], object]


@dataclass(frozen=True)
class Pair:
    """What is measured, and its baseline.

    Attributes:
        ours, theirs: one call of each.
        baseline: what the other is.
        items: how many clouds, or the like, a call of each is for.
    """

    ours: Step
    theirs: Step
    baseline: str
    items: tuple[int, int] = (1, 1)


def seconds(step: Step, rounds: int = 4, clock: Callable[[], float] = time.perf_counter) -> float:
    """The least of some calls, after one to warm up: what others do on the machine only adds."""
    found = []
    for _ in range(1 + rounds):
        begin = clock()
        step()
        finish()
        found.append(clock() - begin)
    return min(found[1:])


def compare(
    name: str, pair: Pair, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    """Time both and print the ratio; where benchmarks are not enabled each is called once."""

    def step() -> None:
        pair.ours()
        finish()

    benchmark.pedantic(step, rounds=4 if ENABLED else 1, warmup_rounds=int(ENABLED))
    if not ENABLED:
        pair.theirs()
        return
    ours = benchmark.stats.stats.min / pair.items[0]
    theirs = seconds(pair.theirs) / pair.items[1]
    benchmark.extra_info["times_faster"] = theirs / ours
    show(
        capsys,
        f"{name}: {1e3 * ours:.2f} ms, {pair.baseline} {1e3 * theirs:.2f} ms: "
        f"{theirs / ours:.1f} times faster, {WHERE}",
    )


def show(capsys: pytest.CaptureFixture, *lines: str) -> None:
    """Print lines past pytest's capture."""
    with capsys.disabled():
        print("", *lines, sep="\n")  # noqa: T201


def finish() -> None:
    """Wait for what the device was asked for."""
    if DEVICE.type == "cuda":
        torch.cuda.synchronize(DEVICE)
