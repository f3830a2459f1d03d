"""EdgeConv's operations for accelerators: gradients, what torch asks of them, Triton's kernels.

That a layer and whole nets come out as by their formulas: test_plain_form.py, ../test_device.py.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from qs3.kernels import edge_norm
from tests.triton import in_interpreter, needs_triton


def _inputs(r: int, d: int, k: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    torch.manual_seed(0)
    pr, gamma, beta = torch.randn(r, 2 * d), torch.randn(d), torch.randn(d)
    return pr.to(dtype), torch.randint(r, (r, k)), gamma.to(dtype), beta.to(dtype)


def test_gradients_are_those_of_differences() -> None:
    pr, index, gamma, beta = _inputs(9, 4, 3, torch.float64)
    leaves = [x.requires_grad_() for x in (pr, gamma, beta)]
    assert torch.autograd.gradcheck(
        lambda pr, gamma, beta: edge_norm.edge_norm(pr, index, gamma, beta, 0.1, 0.2)[0], leaves
    )


def test_known_statistics() -> None:
    """Of the edges written out, where P and R lie far from 0."""
    pr, index, gamma, beta = _inputs(40, 3, 5, torch.float32)
    pr = pr + 100
    _, mean, var = edge_norm.edge_norm(pr, index, gamma, beta, 1e-5, 0.2)
    p, r = pr.double().chunk(2, dim=1)
    z = (p[index] + (r - p)[:, None]).flatten(0, 1)
    torch.testing.assert_close(mean.double(), z.mean(0), rtol=1e-6, atol=0)
    torch.testing.assert_close(var.double(), z.var(0, unbiased=False), rtol=1e-4, atol=0)


# Channels and points that fill no block, a point that one names twice, and one that nobody names.
COMPARE = """
import torch
from qs3.kernels import edge_norm, triton_edge_norm
for r, d, k in ((50, 12, 7), (70, 70, 17), (3, 1, 1)):
    torch.manual_seed(0)
    pr, index, gamma = torch.randn(r, 2 * d), torch.randint(1, r, (r, k)), torch.randn(d)
    index[:, -1] = index[:, 0]
    grad, beta, close = torch.randn(r, d), torch.randn(d), {"rtol": 1e-4, "atol": 1e-4}
    named, order = index.flatten().int().sort(stable=True)
    first = torch.searchsorted(named, torch.arange(r + 1).int())
    found = []
    for way in (edge_norm, triton_edge_norm):
        pivot = pr[:, d:].mean(0)
        best, taken, sums, own, parts = way.edge_extremes(pr, index, gamma, pivot)
        y, t, constants = way.edge_output(
            best, parts.sum(1), pivot, gamma, beta, r * k, 1e-5, 0.2
        )
        du, of_norm = way.edge_output_gradient(grad, y, t, constants, 0.2)
        out = way.edge_gradient(
            pr, own, du, taken, sums, first, order, constants, of_norm.sum(1)
        )
        found.append((best, taken, sums, own, parts.sum(1), y, t, constants, du, out))
    for mine, theirs in zip(*found, strict=True):
        torch.testing.assert_close(mine, theirs, **close)
    print("same")
"""


@needs_triton
def test_the_kernels_are_the_operations() -> None:
    assert in_interpreter(COMPARE) == ["same"] * 3


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("d", [64, 70, 256])
def test_on_a_gpu(d: int) -> None:
    """The kernels against the operations in float64."""
    found = []
    for dtype in (torch.float32, torch.float64):
        pr, index, gamma, beta = (x.cuda() for x in _inputs(4096, d, 20, torch.float32))
        leaves = [x.to(dtype).requires_grad_() for x in (pr, gamma, beta)]
        out, mean, var = edge_norm.edge_norm(leaves[0], index, *leaves[1:], 1e-5, 0.2)
        (out * torch.linspace(-1, 1, d, device="cuda", dtype=dtype)).sum().backward()
        found.append([out.detach(), mean, var, *(x.grad for x in leaves)])
    for mine, theirs in zip(*found, strict=True):
        off = (mine.double() - theirs).norm() / theirs.norm()
        assert off < 1e-5
