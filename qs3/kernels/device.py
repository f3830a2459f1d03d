"""Which way an operation goes: by numpy, by kernels of this processor or GPU, into a graph."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

ROWS = 16  # that a program of such a kernel adds up, where sums over all rows are taken
_HAS_TRITON = find_spec("triton") is not None


def takes_triton(x: Tensor) -> bool:
    """Whether kernels written in Triton run where `x` lies: on GPUs, with torch's builds for them.

    On torch's device without values (`meta`) as well, so that what a step would start there can be
    counted and traced.
    """
    return x.is_meta or (x.is_cuda and _HAS_TRITON)


def triton_kernels(module: str, x: Tensor) -> Any:
    """The module of `qs3.kernels` with kernels for `x`, or None: they are made for float32."""
    if not (x.is_cuda and takes_triton(x) and x.dtype == torch.float32):
        return None
    return import_module(f"qs3.kernels.{module}")


def implementation(module: str, kernels: str, x: Tensor) -> Any:
    """Where a module's operations are taken from: the kernels save an operation's own way."""
    compiling = torch.compiler.is_compiling()  # whose graph has operations
    return (not compiling and triton_kernels(kernels, x)) or sys.modules[module]


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


def lists_of(
    index: Int[Tensor, "*b m"], rows: int
) -> tuple[Int[Tensor, "*b {rows}+1"], Int[Tensor, "*b m"]]:
    """Which entries of `index` name each row, in their order.

    Returns:
        first: where in `order` the list of each row begins, and the last one ends.
        order: int64, the entries row by row.
    """
    if rows >= 1 << 16:
        kind, least = torch.int32, 0
    else:  # half as many passes of a radix sort
        kind, least = torch.int16, 0 if rows < 1 << 15 else -(1 << 15)
    shifted = index if least == 0 else index + least
    # A stable sort, so that the order in which a list is summed never changes.
    named, order = shifted.to(kind).sort(dim=-1, stable=True)
    points = torch.arange(least, least + rows + 1, dtype=kind, device=index.device)
    points = points.expand(*index.shape[:-1], -1).contiguous()
    return torch.searchsorted(named, points), order


def takes_numpy(x: Tensor) -> bool:
    """On the CPU, unless an export writes down what is done to `x`: other devices' way is torch."""
    return x.device.type == "cpu" and not exporting()


def exporting() -> bool:
    """Whether `torch.export` (of `torch.onnx.export` too) is making a graph of what is done."""
    if hasattr(torch.compiler, "is_exporting"):  # since torch 2.7
        return torch.compiler.is_exporting()
    return torch.compiler.is_compiling() and not torch.compiler.is_dynamo_compiling()
