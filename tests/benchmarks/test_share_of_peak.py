"""How near each net comes to what the processor can do, and what takes the rest: one thread.

Counted are the floating point operations of products and convolutions that really run (backward
passes too); the peak is that of a large product of matrices, in the same process, by the faster of
the two libraries. What takes the rest is by torch's profiler: time inside an operation, without
what it calls. Outside of torch is what no operation of torch's own takes: numpy, Python, and the
loops that numba compiles.
"""

from __future__ import annotations

import math
import platform
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from qs3.kernels import compiled
from qs3.kernels.matmul import matmul_t
from tests.benchmarks.test_simpleview_speed import boxes
from tests.benchmarks.test_throughput import _inference, _net, _training
from tests.models.test_all_nets import NETS

BATCH, POINTS, SIDE, ROUNDS = 16, 1024, 2048, 3
PRODUCTS = ("mm", "bmm", "addmm", "baddbmm", "convolution", "linear", "einsum", "matmul")
SHOWN, OUTSIDE = 4, "outside of torch"
CPUINFO = Path("/proc/cpuinfo")


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


def peak() -> tuple[float, str]:
    """Floating point operations a second of a product of square matrices, and whose it is."""
    a, b = torch.randn(2, SIDE, SIDE)
    ways: dict[str, Callable[[], object]] = {"MKL": lambda: a @ b, "oneDNN": lambda: matmul_t(a, b)}
    found = {name: 2 * SIDE**3 / best_of(way) for name, way in ways.items()}
    best = max(found, key=lambda name: found[name])
    return found[best], best


def processor() -> str:
    """What the system calls it, and the vectors that torch takes on it."""
    lines = CPUINFO.read_text().splitlines() if CPUINFO.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return (
        f"{names[0] if names else platform.processor()}, {torch.backends.cpu.get_cpu_capability()}"
    )


def shares(step: Callable[[], object]) -> Counter[str]:
    """Of a step's time, by operation; products together, and what is outside of torch."""
    with profile(activities=[ProfilerActivity.CPU]) as seen:
        begin = time.perf_counter()
        step()
        total = 1e6 * (time.perf_counter() - begin)
    found: Counter[str] = Counter()
    for event in seen.key_averages():
        name = event.key.removeprefix("aten::").rstrip("_")
        is_product = any(word == name or word in name.split("_") for word in PRODUCTS)
        ours = OUTSIDE if name.startswith("qs3::") else name
        key = "products" if is_product else ours
        found[key] += event.self_cpu_time_total
    found[OUTSIDE] += max(0.0, total - sum(found.values()))
    return Counter({name: value / sum(found.values()) for name, value in found.items()})


def row(name: str, what: str, step: Callable[[], object], most: float) -> str:
    """A line of the table."""
    step()
    count, seconds = flops(step), best_of(step)
    parts = shares(step)
    named = ("products", OUTSIDE)
    rest = [one for one in parts.most_common() if one[0] not in named][:SHOWN]
    words = ", ".join(f"{op} {share:.0%}" for op, share in rest)
    return (
        f"| {name} | {what} | {count / 1e9:.1f} | {1e3 * seconds:.0f} | "
        f"{count / seconds / most:.0%} | {parts['products']:.0%} | {parts[OUTSIDE]:.0%} | {words} |"
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


def test_what_is_outside_of_torch_is_seen() -> None:
    """A step that mostly sleeps, and one of numba's kernels."""
    x, index = torch.randn(3000, 64), torch.randint(3000, (3000, 20))
    compiled.neighbour_max(x, index)
    assert shares(lambda: (x.relu(), time.sleep(0.1)))[OUTSIDE] > 0.5
    found = shares(lambda: compiled.neighbour_max(x, index))
    assert found[OUTSIDE] > 0.5
    assert not [name for name in found if name.startswith("qs3")]


def test_share_of_peak(benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    """The benchmark's own time is that of DGCNN's step."""
    if not benchmark.enabled:
        benchmark(_inference(_net("pointnet"), boxes(2, 64)))
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        points, (most, whose) = boxes(BATCH, POINTS), peak()
        lines = [
            f"\n{BATCH} x {POINTS}, one thread of {processor()}, peak {most / 1e9:.0f} GFLOP/s "
            f"({whose}'s product of {SIDE} x {SIDE})",
            "| net | | GFLOP | ms | of the peak | products' share of the time | outside of torch | "
            "the rest |",
            "|---|---|---|---|---|---|---|---|",
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
