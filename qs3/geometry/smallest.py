"""The k smallest values of rows as one operation of an accelerator.

torch's topk orders a row by radix passes over it, several kernels of them; for the few neighbours
of a point it is faster to hold the row in registers and to take its least value k times.
"""

from __future__ import annotations

import torch
from torch import Tensor

from qs3.geometry.device import takes_triton

_LARGEST = 1 << 12  # values of a row that a warp or a few can hold


@torch.library.custom_op("qs3::smallest_of_rows", mutates_args=())
def smallest_sums(values: Tensor, more: Tensor, k: int) -> Tensor:
    """Columns of the k smallest values of each row after `more` is added to them, smallest first.

    `qs3.geometry.compiled.smallest_sums` is the CPU's. Of equal values any comes first; NaN last.

    Args:
        values: [b, r, n].
        more: [b, n], of each of the r rows.
        k: at most `n`.

    Returns:
        int64 [b, r, k].
    """
    if values.is_cuda and takes_triton(values) and fits(values):
        from qs3.geometry import triton_smallest

        return triton_smallest.smallest_sums(values, more, k)
    return (values + more[:, None]).topk(k, largest=False)[1]


@smallest_sums.register_fake
def _(values: Tensor, more: Tensor, k: int) -> Tensor:
    return values.new_empty(*values.shape[:2], k, dtype=torch.int64)


def fits(values: Tensor) -> bool:
    """Whether the kernel is made for rows such as these, [..., n]."""
    return values.dtype == torch.float32 and values.shape[-1] <= _LARGEST
