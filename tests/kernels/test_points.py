"""Farthest points and the k smallest of rows as an accelerator's operations, and in Triton."""

from __future__ import annotations

import pytest
import torch

from qs3.kernels.points import farthest_points, smallest_sums
from tests.triton import in_interpreter, needs_triton


def test_sums_are_ranked() -> None:
    values = torch.tensor([[[3.0, 1.0, 2.0], [0.0, 5.0, 1.0]]])
    more = torch.tensor([[0.0, 10.0, -1.5]])
    assert smallest_sums(values, more, 2).tolist() == [[[2, 0], [2, 0]]]


# Rows that fill no block, as many as there are groups and more; infinities, and NaN, which come
# last and never out of range. Clouds with copies.
COMPARE = """
import torch
from qs3.kernels import points, triton_points
for n, k in ((50, 7), (70, 70), (1, 1), (200, 20), (128, 32), (150, 33)):
    torch.manual_seed(0)
    values, more = torch.randn(2, 6, n), torch.randn(2, n)
    values[0, 1, : n // 3] = torch.inf
    kernel = triton_points.smallest_sums(values, more, k)
    finite = torch.ones(2, 6, dtype=bool)
    finite[0, 1] = k <= n - n // 3
    assert torch.equal(kernel[finite], points.smallest_sums(values, more, k)[finite]), (n, k)
    values[0, 0], values[1, 2, 0] = torch.nan, torch.nan
    kernel = triton_points.smallest_sums(values, more, k)
    assert kernel[0, 0].tolist() == list(range(k))
    for row in kernel.flatten(0, 1):
        assert len(set(row.tolist())) == k and 0 <= row.min() and row.max() < n
    assert k == n or 0 not in kernel[1, 2]
    print("same")
for b, n, taken in ((3, 70, 70), (2, 64, 9), (1, 1, 1)):
    x, start = torch.randn(b, n, 3), torch.randint(n, (b,))
    x[:, n // 2 :] = x[:, : n - n // 2]
    kernel = triton_points.farthest_points(x, taken, start)
    assert torch.equal(kernel, points.farthest_points(x, taken, start)), (b, n, taken)
    print("same")
"""


@needs_triton
def test_the_kernels_are_the_operations() -> None:
    assert in_interpreter(COMPARE) == ["same"] * 9


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu() -> None:
    torch.manual_seed(0)
    values, more = torch.randn(3, 64, 1024).cuda(), torch.randn(3, 1024).cuda()
    expected = (values + more[:, None]).topk(20, largest=False)[1]
    assert torch.equal(smallest_sums(values, more, 20), expected)
    x, start = torch.randn(16, 1000, 3), torch.randint(1000, (16,))
    there = farthest_points(x.cuda(), 1000, start.cuda())
    assert torch.equal(there.cpu(), farthest_points(x, 1000, start))
