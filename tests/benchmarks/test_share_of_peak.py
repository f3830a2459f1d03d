"""How near each net comes to what the processor can do, and what takes the rest: one thread.

Counted are the floating point operations of products and convolutions that really run (backward
passes too); the peak is that of a large product of matrices, in the same process. What takes the
rest is by torch's profiler: time inside an operation, without what it calls.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from tests.benchmarks.test_simpleview_speed import boxes
from tests.benchmarks.test_throughput import _inference, _net, _training
from tests.models.test_all_nets import NETS

BATCH, POINTS, SIDE, ROUNDS = 16, 1024, 2048, 3
PRODUCTS = ("mm", "bmm", "addmm", "baddbmm", "convolution", "linear", "einsum", "matmul")
SHOWN = 4


def best_of(step: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Seconds, after one round to warm up."""
    found = []
    for _ in range(1 + rounds):
        begin = time.perf_counter()
        step()
        found.append(time.perf_counter() - begin)
    return min(found[1:])


def linear_flops(points: Sequence[int], weight: Sequence[int], *_: object, **__: object) -> int:
    """Of oneDNN's layer: points [..., K], weight [N, K]; torch's counter does not know it."""
    return 2 * math.prod(points) * weight[0]


def flops(step: Callable[[], object]) -> int:
    """Of products and convolutions, two for each multiplication with its addition."""
    linear = {torch.ops.mkldnn._linear_pointwise: linear_flops}
    with FlopCounterMode(display=False, custom_mapping=linear) as counter:
        step()
    return int(counter.get_total_flops())


def peak() -> float:
    """Floating point operations a second of a product of square matrices."""
    a, b = torch.randn(2, SIDE, SIDE)
    return 2 * SIDE**3 / best_of(lambda: a @ b)


def shares(step: Callable[[], object]) -> Counter[str]:
    """Of a step's time, by operation; products together."""
    with profile(activities=[ProfilerActivity.CPU]) as seen:
        step()
    found: Counter[str] = Counter()
    for event in seen.key_averages():
        name = event.key.removeprefix("aten::").rstrip("_")
        is_product = any(word == name or word in name.split("_") for word in PRODUCTS)
        found["products" if is_product else name] += event.self_cpu_time_total
    total = sum(found.values())
    return Counter({name: value / total for name, value in found.items()})


def row(name: str, what: str, step: Callable[[], object], most: float) -> str:
    """A line of the table."""
    step()
    count, seconds = flops(step), best_of(step)
    parts = shares(step)
    rest = [one for one in parts.most_common() if one[0] != "products"][:SHOWN]
    words = ", ".join(f"{op} {share:.0%}" for op, share in rest)
    return (
        f"| {name} | {what} | {count / 1e9:.1f} | {1e3 * seconds:.0f} | "
        f"{count / seconds / most:.0%} | {parts['products']:.0%} | {words} |"
    )


def test_flops_of_a_product_are_counted() -> None:
    a, b = torch.randn(8, 16), torch.randn(16, 32)
    assert flops(lambda: a @ b) == 2 * 8 * 16 * 32
    weight = torch.randn(32, 16)
    fused = torch.ops.mkldnn._linear_pointwise
    assert flops(lambda: fused(a, weight, None, "none", [], "")) == 2 * 8 * 16 * 32
    found = shares(lambda: (a @ b).relu())
    assert found["products"] > 0
    assert abs(sum(found.values()) - 1) < 1e-6


def test_share_of_peak(benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    """The benchmark's own time is that of DGCNN's step."""
    if not benchmark.enabled:
        benchmark(_inference(_net("pointnet"), boxes(2, 64)))
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        points, most = boxes(BATCH, POINTS), peak()
        lines = [
            f"\n{BATCH} x {POINTS}, one thread, peak {most / 1e9:.0f} GFLOP/s (product of {SIDE} x "
            f"{SIDE})",
            "| net | | GFLOP | ms | of the peak | products' share of the time | the rest |",
            "|---|---|---|---|---|---|---|",
        ]
        for name in NETS:
            net = _net(name)
            lines.append(row(name, "training", _training(net, points), most))
            lines.append(row(name, "inference", _inference(net, points), most))
        benchmark.pedantic(_training(_net("dgcnn"), points), rounds=1)
    finally:
        torch.set_num_threads(before)
    with capsys.disabled():
        print("\n".join(lines))  # noqa: T201
