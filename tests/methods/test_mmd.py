import math

import pytest
import torch

from qs3.methods.mmd import mmd2
from qs3.methods.pointdan import SIGMAS


def brute_force(x, y, sigmas):
    def kernel(a, b):
        return sum(math.exp(-float((a - b).square().sum()) / (2 * s * s)) for s in sigmas)

    def mean(u, v):
        return sum(kernel(a, b) for a in u for b in v) / (len(u) * len(v))

    return mean(x, x) + mean(y, y) - 2 * mean(x, y)


@pytest.mark.parametrize("sizes", [(5, 5), (3, 8), (1, 1)])
def test_against_brute_force(sizes: tuple[int, int]) -> None:
    torch.manual_seed(0)
    x = torch.randn(sizes[0], 7, dtype=torch.float64)
    y = torch.randn(sizes[1], 7, dtype=torch.float64) + 1
    assert mmd2(x, y, SIGMAS).item() == pytest.approx(brute_force(x, y, SIGMAS), abs=1e-10)


def test_known_answers() -> None:
    x = torch.tensor([[0.0, 0.0]])
    y = torch.tensor([[3.0, 4.0]])  # at distance 5
    assert mmd2(x, y, [5.0]).item() == pytest.approx(2 - 2 * math.exp(-0.5))
    assert mmd2(x, x, SIGMAS).item() == 0
    far = torch.full((1, 2), 1e6)
    assert mmd2(x, far, SIGMAS).item() == pytest.approx(2 * len(SIGMAS))


def test_many_features_lose_no_kernel_to_rounding() -> None:
    torch.manual_seed(0)
    x, y = torch.randn(6, 4096), torch.randn(6, 4096)
    expected = brute_force(x.double(), y.double(), SIGMAS)
    assert mmd2(x, y, SIGMAS).item() == pytest.approx(expected, rel=1e-4)


def test_gradient() -> None:
    torch.manual_seed(0)
    x = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    y = torch.randn(5, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: mmd2(a, b, (0.5, 2.0)), (x, y))
