"""The lens of `qs3 fit images=`: OpenCV's separable filter against a sum of shifted images.

A fit of one still scene calls it some hundreds of times, half of its time with shifted sums.
"""

from __future__ import annotations

import time

import pytest
import torch
import torch.nn.functional as F
from pytest_benchmark.fixture import BenchmarkFixture

from qs3.calibration.fit.infrared_noise import through
from qs3.sensors.gradients.twin import gaussian

ROUNDS = 20


def shifted(image: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """The same by torch's operations, whose tangents torch knows."""
    for axis, kernel in enumerate((rows, columns)):
        reach, length = len(kernel) // 2, image.shape[axis]
        wide = F.pad(image, (0, 0, reach, reach) if axis == 0 else (reach, reach, 0, 0))
        parts = (wide.narrow(axis, i, length) * one for i, one in enumerate(kernel))
        image = sum(parts, torch.zeros_like(image))
    return image


def test_a_lens_of_a_fit(benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture) -> None:
    """480 x 480 float64, a lens of 1.2 px."""
    image = torch.rand(480, 480, dtype=torch.float64)
    kernel = gaussian(torch.tensor(1.2, dtype=torch.float64))
    torch.testing.assert_close(through(image, kernel, kernel), shifted(image, kernel, kernel))
    benchmark.pedantic(through, (image, kernel, kernel), rounds=ROUNDS, warmup_rounds=2)
    if not benchmark.enabled:
        return
    taken = []
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        shifted(image, kernel, kernel)
        taken.append(time.perf_counter() - begin)
    ratio = min(taken) / benchmark.stats.stats.min
    benchmark.extra_info["times_faster"] = ratio
    with capsys.disabled():
        print(f"\nthe lens of a fit: {ratio:.1f} times as fast as shifted sums")  # noqa: T201
