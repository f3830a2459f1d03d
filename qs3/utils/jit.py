"""Loops that numba compiles for this processor, where numba is installed."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any

_SETTINGS: dict[str, Any] = {"nogil": True, "boundscheck": False, "error_model": "numpy"}


@cache
def has_numba() -> bool:
    """Whether numba is there; callers have another way with the same values."""
    return find_spec("numba") is not None


def compiled(kernel: Callable[..., None]) -> Any:
    """`kernel`, compiled at the first call for each type: for modules imported where numba is.

    What was compiled is kept beside the kernel's file, or in the user's cache.
    """
    import numba

    try:
        return numba.njit(cache=True, **_SETTINGS)(kernel)
    except RuntimeError:  # neither folder can be written
        return numba.njit(**_SETTINGS)(kernel)
