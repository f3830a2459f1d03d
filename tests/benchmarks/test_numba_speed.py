"""DGCNN with the kernels that numba compiles against torch's operations, in one process.

They are of the CPU.
"""

from __future__ import annotations

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture

from qs3.kernels import compiled
from qs3.models.dgcnn import dgcnn
from tests.benchmarks.device import WHERE
from tests.benchmarks.test_dgcnn_speed import _fastest, _step


@pytest.mark.parametrize(("b", "n"), [(16, 256), (16, 1024)])
def test_what_numba_brings(
    b: int,
    n: int,
    benchmark: BenchmarkFixture,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    """A training step with the kernels of `qs3.kernels.compiled` against torch's operations."""
    torch.manual_seed(0)
    points, labels = torch.randn(b, n, 3) / 2, torch.randint(10, (b,))
    step = _step(dgcnn(10), points, labels)
    benchmark.pedantic(step, rounds=6, warmup_rounds=1)
    monkeypatch.setattr(compiled, "has_numba", lambda: False)
    theirs = _fastest(step, 6 if benchmark.enabled else 1)
    if not benchmark.enabled:
        return
    ratio = theirs / benchmark.stats.stats.min
    benchmark.extra_info["times_faster"] = ratio
    with capsys.disabled():
        print(f"\nDGCNN, {b} x {n}: {ratio:.2f} times faster with numba, {WHERE}")  # noqa: T201
