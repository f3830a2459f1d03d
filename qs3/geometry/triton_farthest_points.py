"""Farthest points of a batch in one kernel. Imported where Triton is, and there is a GPU."""

from __future__ import annotations

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor


@triton.jit
@no_type_check
def _kernel(points, start, out, n, steps, BLOCK: tl.constexpr):
    """One cloud a program: its points and their distances stay in registers."""
    cloud = tl.program_id(0).to(tl.int64)
    at = tl.arange(0, BLOCK)
    here = at < n
    row = points + cloud * n * 3
    x = tl.load(row + 3 * at, mask=here, other=0.0)
    y = tl.load(row + 3 * at + 1, mask=here, other=0.0)
    z = tl.load(row + 3 * at + 2, mask=here, other=0.0)
    nearest = tl.where(here, float("inf"), -2.0)  # squared distance to the points taken so far
    last = tl.load(start + cloud).to(tl.int32)
    for i in range(steps):
        tl.store(out + cloud * steps + i, last.to(tl.int64))
        dx = x - tl.load(row + 3 * last)
        dy = y - tl.load(row + 3 * last + 1)
        dz = z - tl.load(row + 3 * last + 2)
        nearest = tl.minimum(nearest, dx * dx + dy * dy + dz * dz)
        nearest = tl.where(at == last, -1.0, nearest)  # never again
        last = tl.argmax(nearest, axis=0)


def farthest_points(x: Tensor, n: int, start: Tensor) -> Tensor:
    """As `qs3.geometry.farthest_points.farthest_points`."""
    b, total, _ = x.shape
    out = torch.empty(b, n, dtype=torch.int64, device=x.device)
    block = triton.next_power_of_2(total)
    settings: dict[str, Any] = {
        "BLOCK": block,
        "num_warps": max(1, min(16, block // 256)),
        "enable_fp_fusion": False,  # the rounding of the steps, so that ties fall alike
    }
    with torch.cuda.device_of(x):
        _kernel[(b,)](x.contiguous(), start.contiguous(), out, total, n, **settings)
    return out
