"""Maximum and mean of a linear layer by an accelerator's operations: gradients, Triton's kernels.

That whole nets come out as on the CPU: ../test_device.py.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from qs3.kernels import linear_max
from qs3.kernels.device import lists_of
from tests.triton import in_interpreter, needs_triton


def _inputs(b: int, n: int, c: int, d: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    torch.manual_seed(0)
    return torch.randn(b, n, c).to(dtype), torch.randn(d, c).to(dtype)


def test_values_and_gradients_are_those_of_the_layer() -> None:
    x, weight = (t.requires_grad_() for t in _inputs(3, 7, 4, 5, torch.float64))
    y = x @ weight.T
    expected = torch.cat([y.amax(1), y.mean(1)], 1)
    torch.testing.assert_close(linear_max.pooled_linear(x, weight), expected)
    assert torch.autograd.gradcheck(linear_max.pooled_linear, (x, weight))


@pytest.mark.parametrize("rows", [5, 1 << 15, (1 << 16) - 1, 1 << 16])
def test_lists_name_each_row_s_entries_in_order(rows: int) -> None:
    """At the sizes where other numbers are sorted."""
    torch.manual_seed(0)
    index = torch.randint(rows, (2, 3, 40))
    index[..., 0], index[..., -1] = 0, rows - 1
    first, order = lists_of(index, rows)
    assert first.shape == (2, 3, rows + 1)
    for given, begins, ordered in zip(
        *(t.flatten(0, 1) for t in (index, first, order)), strict=True
    ):
        for row in {0, 1, rows // 2, rows - 1, *given.tolist()}:
            mine = ordered[begins[row] : begins[row + 1]]
            assert mine.tolist() == (given == row).nonzero()[:, 0].tolist()


# Channels that fill no block, a point that has many maxima, and gradients of more than the maxima.
COMPARE = """
import torch
from qs3.kernels.device import lists_of
from qs3.kernels import linear_max, triton_linear_max
for b, n, c, d in ((2, 9, 5, 30), (3, 20, 130, 17), (1, 1, 1, 1)):
    torch.manual_seed(0)
    x, weight, grad = torch.randn(b, n, c), torch.randn(d, c), torch.randn(b, 2 * d)
    x[:, 3 % n] *= 10
    where = (x @ weight.T).max(1)[1]
    first, order = lists_of(where, n)
    found = []
    for way in (linear_max, triton_linear_max):
        points = way.points_gradient(grad, weight, torch.ones(b, c), first, order)
        found.append((points, way.weight_gradient(grad, x, where, weight)))
    for mine, theirs in zip(*found, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-5)
    print("same")
"""


@needs_triton
def test_the_kernels_are_the_operations() -> None:
    assert in_interpreter(COMPARE) == ["same"] * 3


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize(("n", "d"), [(100, 70), (1024, 1024)])
def test_on_a_gpu(n: int, d: int) -> None:
    """The kernels against torch's own gradients in float64, and twice the same."""
    x, weight = (t.cuda() for t in _inputs(16, n, 512, d, torch.float32))
    scale = torch.linspace(-1, 1, 2 * d, device="cuda")
    found = []
    for _ in range(2):
        leaves = [x.clone().requires_grad_(), weight.clone().requires_grad_()]
        out = linear_max.pooled_linear(*leaves)
        (out * scale).sum().backward()
        found.append([out.detach(), *(leaf.grad for leaf in leaves)])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
    leaves = [x.double().requires_grad_(), weight.double().requires_grad_()]
    y = leaves[0] @ leaves[1].T
    out = torch.cat([y.amax(1), y.mean(1)], 1)
    (out * scale).sum().backward()
    for mine, theirs in zip(found[0], [out, *(leaf.grad for leaf in leaves)], strict=True):
        assert (mine.double() - theirs).norm() / theirs.norm() < 1e-5
