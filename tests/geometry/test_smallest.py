"""The k smallest of rows as an accelerator's operation, and its kernel in Triton."""

from __future__ import annotations

import pytest
import torch

from qs3.geometry.smallest import smallest_sums
from tests.triton import in_interpreter, needs_triton


def test_sums_are_ranked() -> None:
    values = torch.tensor([[[3.0, 1.0, 2.0], [0.0, 5.0, 1.0]]])
    more = torch.tensor([[0.0, 10.0, -1.5]])
    assert smallest_sums(values, more, 2).tolist() == [[[2, 0], [2, 0]]]


@pytest.mark.slow
def test_as_torch_wants_operations() -> None:
    torch.library.opcheck(smallest_sums, (torch.rand(2, 5, 9), torch.rand(2, 9), 4))


# Rows that fill no block, as many as there are groups and more; infinities, and NaN, which come
# last and never out of range.
COMPARE = """
import torch
from qs3.geometry import smallest, triton_smallest
for n, k in ((50, 7), (70, 70), (1, 1), (200, 20), (128, 32), (150, 33)):
    torch.manual_seed(0)
    values, more = torch.randn(2, 6, n), torch.randn(2, n)
    values[0, 1, : n // 3] = torch.inf
    kernel = triton_smallest.smallest_sums(values, more, k)
    finite = torch.ones(2, 6, dtype=bool)
    finite[0, 1] = k <= n - n // 3
    assert torch.equal(kernel[finite], smallest.smallest_sums(values, more, k)[finite]), (n, k)
    values[0, 0], values[1, 2, 0] = torch.nan, torch.nan
    kernel = triton_smallest.smallest_sums(values, more, k)
    assert kernel[0, 0].tolist() == list(range(k))
    for row in kernel.flatten(0, 1):
        assert len(set(row.tolist())) == k and 0 <= row.min() and row.max() < n
    assert k == n or 0 not in kernel[1, 2]
    print("same")
"""


@needs_triton
def test_the_kernel_is_the_operation() -> None:
    assert in_interpreter(COMPARE) == ["same"] * 6


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("n", [70, 1024, 4096])
def test_on_a_gpu(n: int) -> None:
    torch.manual_seed(0)
    values, more = torch.randn(3, 64, n).cuda(), torch.randn(3, n).cuda()
    expected = (values + more[:, None]).topk(20, largest=False)[1]
    assert torch.equal(smallest_sums(values, more, 20), expected)
