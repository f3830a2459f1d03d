"""What an accelerator has beyond torch's own operations."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

import torch
from torch import Tensor

ROWS = 16  # that a program of such a kernel adds up, where sums over all rows are taken
_HAS_TRITON = find_spec("triton") is not None


def takes_triton(x: Tensor) -> bool:
    """Whether kernels written in Triton run where `x` lies: on GPUs, with torch's builds for them.

    On torch's device without values (`meta`) as well, so that what a step would start there can be
    counted and traced.
    """
    return x.is_meta or (x.is_cuda and _HAS_TRITON)


@contextmanager
def exact_products() -> Iterator[None]:
    """Inside, float32 products are of float32 factors, whatever `trainer.float32_matmul` says.

    For distances, of which small ones are differences of large products, and for coordinates.
    """
    before = torch.get_float32_matmul_precision()
    if before == "highest":
        yield
        return
    torch.set_float32_matmul_precision("highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
