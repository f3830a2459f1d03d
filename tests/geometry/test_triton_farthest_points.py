"""The kernel in Triton's interpreter, where Triton is: with torch's builds for GPUs."""

from __future__ import annotations

import pytest
import torch

from qs3.geometry.farthest_points import farthest_points
from tests.triton import in_interpreter, needs_triton

COMPARE = """
import torch
from qs3.geometry import farthest_points, triton_farthest_points
torch.manual_seed(0)
for b, n, taken in ((3, 70, 70), (2, 64, 9), (1, 1, 1)):
    x, start = torch.randn(b, n, 3), torch.randint(n, (b,))
    x[:, n // 2 :] = x[:, : n - n // 2]  # copies
    kernel = triton_farthest_points.farthest_points(x, taken, start)
    assert torch.equal(kernel, farthest_points.farthest_points(x, taken, start)), (b, n, taken)
    print("same")
"""


@needs_triton
def test_the_kernel_takes_the_steps() -> None:
    assert in_interpreter(COMPARE) == ["same"] * 3


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu() -> None:
    torch.manual_seed(0)
    x, start = torch.randn(16, 1000, 3), torch.randint(1000, (16,))
    there = farthest_points(x.cuda(), 1000, start.cuda())
    assert torch.equal(there.cpu(), farthest_points(x, 1000, start))
