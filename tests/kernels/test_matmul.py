"""Products by oneDNN are the plain ones."""

import pytest
import torch

from qs3.kernels import matmul as products
from qs3.kernels.matmul import linear, matmul_t, t_matmul


@pytest.mark.parametrize("operator", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(1, 3, 5), (40, 3, 64), (300, 64, 7), (0, 3, 4)])
def test_equal_to_matmul(
    operator: bool,
    dtype: torch.dtype,
    shape: tuple[int, int, int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if not operator:
        monkeypatch.setattr(products, "_LINEAR", None)
    rows, k, c = shape
    x, weight, bias = (torch.randn(*s, dtype=dtype) for s in ((rows, k), (c, k), (c,)))
    close = {"rtol": 1e-5, "atol": 1e-5}
    torch.testing.assert_close(matmul_t(x, weight), x @ weight.T, **close)
    torch.testing.assert_close(matmul_t(x, weight, bias), x @ weight.T + bias, **close)
    torch.testing.assert_close(matmul_t(x[:, None], weight), (x @ weight.T)[:, None], **close)
    y = torch.randn(rows, c, dtype=dtype)
    torch.testing.assert_close(t_matmul(x, y), x.T @ y, **close)
    strided = torch.randn(k, rows, dtype=dtype).T
    torch.testing.assert_close(matmul_t(strided, weight), strided @ weight.T, **close)


@pytest.mark.parametrize("operator", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_linear_has_the_plain_gradients(
    operator: bool, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not operator:
        monkeypatch.setattr(products, "_LINEAR", None)
    x, weight = torch.randn(3, 40, 7, dtype=dtype), torch.randn(5, 7, dtype=dtype)
    upstream = torch.randn(3, 40, 5, dtype=dtype)
    grads = []
    for product in (linear, torch.nn.functional.linear):
        a, b = x.clone().requires_grad_(), weight.clone().requires_grad_()
        out = product(a, b)
        (out * upstream).sum().backward()
        grads.append((out.detach(), a.grad, b.grad))
    for ours, theirs in zip(*grads, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)
