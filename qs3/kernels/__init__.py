"""Kernels derived from the layers of the nets: the same sums, faster and in less memory.

A layer in `qs3.models` has its paper's formula in `forward` and takes the kernel where `usable()`:
not while a net is exported (most kernels cannot be traced), not inside `plain()`, and off the CPU
only where the kernel saves what an accelerator lacks, too: most are made for a CPU's caches, in
many small parts, of which each would be started there by itself.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from qs3.kernels.device import exporting

_plain = False
_COMPILED = (torch.float32, torch.float64)  # types of the CPU's kernels


def on_cpu(x: Tensor) -> bool:
    """Whether `x` lies on the CPU, which kernels are made for."""
    return x.device.type == "cpu"


def usable(x: Tensor, *, anywhere: bool = False, traceable: bool = False) -> bool:
    """Whether a layer may take its kernel for `x` now.

    Args:
        x: the layer's input.
        anywhere: the kernel serves on every device, not on the CPU alone.
        traceable: it may be exported as well.
    """
    here = x.dtype in _COMPILED if on_cpu(x) else anywhere
    return here and not _plain and (traceable or not exporting())


def is_plain() -> bool:
    """Whether this is inside `plain`."""
    return _plain


@contextmanager
def plain() -> Iterator[None]:
    """Inside, all nets of this process compute what their formulas say, step by step."""
    global _plain
    before, _plain = _plain, True
    try:
        yield
    finally:
        _plain = before
