"""A training step of each method relative to source only, in one process.

What to expect: the ratio of forward passes. Source only has one, DANN and DefRec two, GAST five.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import nn

from qs3.methods.base import Method
from qs3.methods.dann import Dann
from qs3.methods.defrec import DefRec
from qs3.methods.gast import Gast
from qs3.methods.pcm import Pcm
from qs3.methods.pointdan import PointDan
from qs3.methods.source_only import SourceOnly
from qs3.methods.student import Student
from qs3.models.dgcnn import dgcnn
from qs3.models.pointdan import pointdan

# Method, its net, and how often a batch passes through the net.
METHODS: dict[str, tuple[Callable[[], Method], Callable[[int], nn.Module], int]] = {
    "pcm": (Pcm, dgcnn, 1),
    "dann": (Dann, dgcnn, 2),
    "defrec": (DefRec, dgcnn, 2),
    "defrec_pcm": (lambda: DefRec(pcm=True), dgcnn, 2),
    "gast": (Gast, dgcnn, 5),
    "gast_no_rotation": (lambda: Gast(rot_weight=0.0), dgcnn, 3),
    "student_source": (Student, dgcnn, 2),
    "pointdan": (PointDan, pointdan, 2),
}


def _step(method: Method, net: Any, b: int, n: int) -> Callable[[], None]:
    torch.manual_seed(0)
    method.prepare(net)
    points = torch.randn(2, b, n, 3)
    points = points / points.norm(dim=3).amax(2)[:, :, None, None]
    labels = torch.randint(10, (b,))
    batch = {
        "source": {"points": points[0], "y_source": labels},
        "target": {"points": points[1], "y_pseudo": labels},
        "progress": 0.5,
    }
    generator = torch.Generator().manual_seed(0)

    def step() -> None:
        net.zero_grad()
        method.zero_grad()
        torch.stack(list(method.loss(net, batch, generator).values())).sum().backward()

    return step


@pytest.mark.parametrize("name", METHODS)
def test_step(name: str, benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    b, n = (16, 1024) if benchmark.enabled else (2, 64)
    make, build, passes = METHODS[name]
    step = _step(make(), build(10), b, n)
    rounds = 4
    benchmark.pedantic(step, rounds=rounds, warmup_rounds=1)
    if not benchmark.enabled:
        return
    plain = _step(SourceOnly(), build(10), b, n)  # of the same net
    times: dict[str, list[float]] = {"ours": [], "plain": []}
    for _ in range(rounds):  # in turns, so that a busy machine is as busy for both
        for key, call in (("plain", plain), ("ours", step)):
            begin = time.perf_counter()
            call()
            times[key].append(time.perf_counter() - begin)
    ours, theirs = min(times["ours"]), min(times["plain"])
    benchmark.extra_info["times_source_only"] = ours / theirs
    with capsys.disabled():
        print(  # noqa: T201
            f"\n{name}, {build.__name__}, {b} x {n}: {ours * 1e3:.0f} ms, source only "
            f"{theirs * 1e3:.0f} ms: {ours / theirs:.2f} times, for {passes} passes to 1"
        )
