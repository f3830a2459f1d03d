"""Kernels derived from the layers of the nets: the same sums, faster and in less memory.

A layer in `qs3.models` has its paper's formula in `forward` and takes the kernel where `usable()`:
not while a net is exported (most kernels cannot be traced), and not inside `plain()`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from qs3.geometry.neighbours import exporting

_plain = False


def usable(*, traceable: bool = False) -> bool:
    """Whether a layer may take its kernel now; a `traceable` one may be exported as well."""
    return not _plain and (traceable or not exporting())


@contextmanager
def plain() -> Iterator[None]:
    """Inside, all nets of this process compute what their formulas say, step by step."""
    global _plain
    before, _plain = _plain, True
    try:
        yield
    finally:
        _plain = before
