"""The kernel in Triton's interpreter, where Triton is: with torch's builds for GPUs."""

from __future__ import annotations

import importlib

import pytest
import torch

from qs3.geometry.farthest_points import farthest_points

pytest.importorskip("triton", reason="comes with torch's builds for GPUs")


@pytest.mark.parametrize(("b", "n", "taken"), [(3, 70, 70), (2, 64, 9), (1, 1, 1)])
def test_the_kernel_takes_the_steps(
    b: int, n: int, taken: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    module = importlib.import_module("qs3.geometry.triton_farthest_points")
    kernel = importlib.reload(module).farthest_points
    torch.manual_seed(0)
    x, start = torch.randn(b, n, 3), torch.randint(n, (b,))
    x[:, n // 2 :] = x[:, : n - n // 2]  # copies
    assert torch.equal(kernel(x, taken, start), farthest_points(x, taken, start))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu() -> None:
    torch.manual_seed(0)
    x, start = torch.randn(16, 1000, 3), torch.randint(1000, (16,))
    there = farthest_points(x.cuda(), 1000, start.cuda())
    assert torch.equal(there.cpu(), farthest_points(x, 1000, start))
