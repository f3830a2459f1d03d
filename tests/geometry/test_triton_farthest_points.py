"""The kernel in Triton's interpreter, where Triton is: with torch's builds for GPUs."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec

import pytest
import torch

from qs3.geometry.farthest_points import farthest_points

# A process of its own: Triton asks for its interpreter when it is first imported.
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


@pytest.mark.skipif(
    find_spec("triton") is None,
    reason="Triton is missing: docs/reference/accelerators.md says how to bring it",
)
def test_the_kernel_takes_the_steps() -> None:
    found = subprocess.run(
        [sys.executable, "-c", COMPARE],
        env=os.environ | {"TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.stdout.split() == ["same"] * 3, found.stderr


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu() -> None:
    torch.manual_seed(0)
    x, start = torch.randn(16, 1000, 3), torch.randint(1000, (16,))
    there = farthest_points(x.cuda(), 1000, start.cuda())
    assert torch.equal(there.cpu(), farthest_points(x, 1000, start))
