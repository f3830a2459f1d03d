"""Matrix products on the CPU by oneDNN where that is faster.

torch hands float32 products on the CPU to MKL, which does not use AVX-512 on processors of other
makers; oneDNN does, and is there about twice as fast. The operator that reaches it is one that
torch's compiler uses; where it is missing, or for other types and devices, these are the plain
products. Neither is differentiable: they are for the inside of autograd functions.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


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


def times(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """The product x W' + bias: [..., k], [c, k] and [c] to [..., c]."""
    if _LINEAR is not None and x.dtype == torch.float32 and x.device.type == "cpu" and x.numel():
        return _LINEAR(x, weight, bias, "none", [], "")
    product = x @ weight.T
    return product if bias is None else product.add_(bias)


def outer(x: Tensor, y: Tensor) -> Tensor:
    """X'Y, the sum of the outer products of rows: [r, c] and [r, k] to [c, k]."""
    return times(x.T, y.T)
