"""Matrix products on the CPU by oneDNN where that is faster.

torch hands float32 products on the CPU to MKL, which does not use AVX-512 on processors of other
makers; oneDNN does, and is there about twice as fast. The operator that reaches it is one that
torch's compiler uses; where it is missing, or for other types and devices, these are the plain
products. `matmul_t` and `t_matmul` are for the inside of autograd functions, `linear` for outside.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F


def _find() -> Any:
    if not torch.backends.mkldnn.is_available():
        return None
    try:
        operator = torch.ops.mkldnn._linear_pointwise
        one = torch.ones(1, 1)
        return operator if operator(one, one, None, "none", [], "").item() == 1.0 else None
    except (AttributeError, RuntimeError):  # another version of torch
        return None


_LINEAR = _find()


def _applies(x: Tensor) -> bool:
    """Whether the operator is there and for this; torch's compiler takes it for its own."""
    if _LINEAR is None or torch.compiler.is_compiling():
        return False
    return x.dtype == torch.float32 and x.device.type == "cpu" and x.numel() > 0


def matmul_t(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """The product x W' + bias: [..., k], [c, k] and [c] to [..., c]."""
    if _applies(x):
        return _LINEAR(x, weight, bias, "none", [], "")
    product = x @ weight.T
    return product if bias is None else product.add_(bias)


def t_matmul(x: Tensor, y: Tensor) -> Tensor:
    """X'Y, the sum of the outer products of rows: [r, c] and [r, k] to [c, k]."""
    return matmul_t(x.T, y.T)


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return matmul_t(x, weight)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        x, weight = ctx.saved_tensors
        grad = grad.contiguous()
        dx = matmul_t(grad, weight.T.contiguous()) if ctx.needs_input_grad[0] else None
        dweight = None
        if ctx.needs_input_grad[1]:
            dweight = t_matmul(grad.flatten(0, -2), x.flatten(0, -2))
        return dx, dweight


def linear(x: Tensor, weight: Tensor) -> Tensor:
    """The product x W', differentiable once: [..., k] and [c, k] to [..., c]."""
    return _Linear.apply(x, weight) if _applies(x) else F.linear(x, weight)
