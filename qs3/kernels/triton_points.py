"""The kernels of `qs3.kernels.points`. Imported where Triton is, and there is a GPU."""

from __future__ import annotations

from typing import no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor

_FEW = 64  # values of a row that are sorted


@triton.jit
@no_type_check
def _farthest(points, start, out, n, steps, BLOCK: tl.constexpr):
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
    """As the operation."""
    b, total, _ = x.shape
    out = torch.empty(b, n, dtype=torch.int64, device=x.device)
    block = triton.next_power_of_2(total)
    with torch.cuda.device_of(x):  # without fusion: the rounding of the steps, so ties fall alike
        _farthest[(b,)](
            x.contiguous(), start.contiguous(), out, total, n,
            BLOCK=block, num_warps=max(1, min(16, block // 256)), enable_fp_fusion=False,
        )  # fmt: skip
    return out


@triton.jit
@no_type_check
def _smallest(
    values, more, few, out, r, n, k,
    BLOCK: tl.constexpr, BOUNDED: tl.constexpr, FEW: tl.constexpr,
):  # fmt: skip
    """One row a program: it stays in registers.

    Columns are dealt to 32 groups, and the k-th smallest of their least values is no less than the
    k-th smallest of the row, so only what is no more than that is sorted: hardly more than k
    values. Where there are too many, equal ones, or groups are not enough, the least one is taken
    k times.
    """
    row = tl.program_id(0).to(tl.int64)
    at = tl.arange(0, BLOCK)
    here = at < n
    v = tl.load(values + row * n + at, mask=here, other=0.0)
    v += tl.load(more + row // r * n + at, mask=here, other=0.0)
    # Below infinity, which is for what was taken and for what is no column; NaN among the last.
    v = tl.where(v < 3.0e38, v, 3.0e38)
    v = tl.where(here, v, float("inf"))
    left = k
    if BOUNDED:
        least = tl.min(tl.min(tl.reshape(v, [BLOCK // 128, 32, 4]), axis=2), axis=0)
        bound = tl.sum(tl.where(tl.arange(0, 32) == k - 1, tl.sort(least), 0.0), axis=0)
        within = (v <= bound).to(tl.int32)
        count = tl.sum(within, axis=0)
        if count <= FEW:
            slot = tl.cumsum(within, axis=0) - 1
            mine = few + row * FEW
            tl.store(mine + slot, at, mask=within != 0)
            tl.debug_barrier()
            place = tl.arange(0, FEW)
            column = tl.load(mine + place, mask=place < count, other=0)
            s = tl.load(values + row * n + column)
            s += tl.load(more + row // r * n + column)
            s = tl.where(s < 3.0e38, s, 3.0e38)
            bits = s.to(tl.int32, bitcast=True)
            bits = bits ^ ((bits >> 31) & 0x7FFFFFFF)  # in the order of the values
            key = (bits.to(tl.int64) << 32) | column.to(tl.int64)
            key = tl.where(place < count, key, 0x7FFFFFFFFFFFFFFF)
            tl.store(out + row * k + place, tl.sort(key) & 0xFFFFFFFF, mask=place < k)
            left = 0
    for i in range(left):
        first = tl.argmin(v, axis=0)
        tl.store(out + row * k + i, first.to(tl.int64))
        v = tl.where(at == first, float("inf"), v)


def smallest_sums(values: Tensor, more: Tensor, k: int) -> Tensor:
    """As the operation, of float32."""
    b, r, n = values.shape
    out = torch.empty(b, r, k, dtype=torch.int64, device=values.device)
    block = triton.next_power_of_2(n)
    bounded = k <= 32 and n >= 128  # then each group has a column
    few = out.new_empty(b * r if bounded else 1, _FEW, dtype=torch.int32)
    with torch.cuda.device_of(values):
        _smallest[(b * r,)](
            values.contiguous(), more.contiguous(), few, out, r, n, k,
            BLOCK=block, BOUNDED=bounded, FEW=_FEW, num_warps=max(1, block // 1024),
        )  # fmt: skip
    return out
