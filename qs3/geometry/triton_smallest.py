"""The k smallest values of rows in one kernel. Imported where Triton is, and there is a GPU."""

from __future__ import annotations

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor


@triton.jit
@no_type_check
def _kernel(values, more, out, r, n, k, BLOCK: tl.constexpr):
    """One row a program: it stays in registers, and its least value is taken k times."""
    row = tl.program_id(0).to(tl.int64)
    at = tl.arange(0, BLOCK)
    here = at < n
    v = tl.load(values + row * n + at, mask=here, other=0.0)
    v += tl.load(more + row // r * n + at, mask=here, other=0.0)
    # Below infinity, which is for what was taken and for what is no column; NaN among the last.
    v = tl.where(v < 3.0e38, v, 3.0e38)
    v = tl.where(here, v, float("inf"))
    for i in range(k):
        least = tl.argmin(v, axis=0)
        tl.store(out + row * k + i, least.to(tl.int64))
        v = tl.where(at == least, float("inf"), v)


def smallest_sums(values: Tensor, more: Tensor, k: int) -> Tensor:
    """As `qs3.geometry.smallest.smallest_sums`, of float32."""
    b, r, n = values.shape
    out = torch.empty(b, r, k, dtype=torch.int64, device=values.device)
    block = triton.next_power_of_2(n)
    settings: dict[str, Any] = {"BLOCK": block, "num_warps": max(1, block // 1024)}
    with torch.cuda.device_of(values):
        _kernel[(b * r,)](values.contiguous(), more.contiguous(), out, r, n, k, **settings)
    return out
