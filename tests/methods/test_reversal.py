import math

import pytest
import torch
from torch.nn import functional as F

from qs3.methods.reversal import dann_alpha, reverse_gradient, sine_alpha


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
def test_reversal_against_brute_force(alpha: float) -> None:
    """One backward pass gives the head d(loss)/dw and the features -alpha d(loss)/dv."""
    torch.manual_seed(0)
    x = torch.randn(6, 4, dtype=torch.float64)
    v = torch.randn(5, 4, dtype=torch.float64, requires_grad=True)  # of the features
    w = torch.randn(2, 5, dtype=torch.float64, requires_grad=True)  # of the head
    labels = torch.tensor([0, 1, 1, 0, 1, 0])

    F.cross_entropy(reverse_gradient(torch.tanh(x @ v.T), alpha) @ w.T, labels).backward()
    assert v.grad is not None
    assert w.grad is not None

    def loss(v: torch.Tensor, w: torch.Tensor) -> float:
        return F.cross_entropy(torch.tanh(x @ v.T) @ w.T, labels).item()

    step = 1e-6
    for weight, grad, sign in ((v, v.grad, -alpha), (w, w.grad, 1.0)):
        for i in range(weight.numel()):
            moved = weight.detach().clone()
            moved.view(-1)[i] += step
            back = weight.detach().clone()
            back.view(-1)[i] -= step
            if weight is v:
                slope = (loss(moved, w) - loss(back, w)) / (2 * step)
            else:
                slope = (loss(v, moved) - loss(v, back)) / (2 * step)
            assert grad.view(-1)[i].item() == pytest.approx(sign * slope, abs=1e-8)


def test_forward_is_the_identity() -> None:
    x = torch.randn(3, 4)
    assert torch.equal(reverse_gradient(x, 0.7), x)


def test_schedules() -> None:
    assert dann_alpha(0.0) == 0.0
    assert dann_alpha(0.1) == pytest.approx((math.e - 1) / (math.e + 1))
    assert dann_alpha(math.log(3) / 10) == pytest.approx(0.5)
    assert dann_alpha(1.0) == pytest.approx(0.9999092, abs=1e-7)
    assert [sine_alpha(p) for p in (0.0, 1 / 3, 1.0)] == pytest.approx([0.0, 0.5, 1.0])
