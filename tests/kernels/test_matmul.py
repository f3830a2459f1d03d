"""Products by oneDNN are the plain ones, with their gradients."""

import pytest
import torch

from qs3.kernels import matmul as products
from qs3.kernels.matmul import linear, matmul_t, t_matmul


@pytest.mark.parametrize("operator", [True, False])
@pytest.mark.parametrize("shape", [(1, 3, 5), (40, 3, 64), (300, 64, 7), (0, 3, 4)])
def test_equal_to_matmul(operator: bool, shape: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    if not operator:
        monkeypatch.setattr(products, "_LINEAR", None)
    rows, k, c = shape
    close = {"rtol": 1e-5, "atol": 1e-5}
    for dtype in (torch.float32, torch.float64):
        x, weight, bias = (torch.randn(*s, dtype=dtype) for s in ((rows, k), (c, k), (c,)))
        torch.testing.assert_close(matmul_t(x, weight, bias), x @ weight.T + bias, **close)
        torch.testing.assert_close(matmul_t(x[:, None], weight), (x @ weight.T)[:, None], **close)
        y = torch.randn(rows, c, dtype=dtype)
        torch.testing.assert_close(t_matmul(x, y), x.T @ y, **close)
        grads = []
        for product in (linear, torch.nn.functional.linear):
            a, b = x.clone().requires_grad_(), weight.clone().requires_grad_()
            out = product(a, b)
            (out * y).sum().backward()
            grads.append((out.detach(), a.grad, b.grad))
        for ours, theirs in zip(*grads, strict=True):
            torch.testing.assert_close(ours, theirs, **close)
