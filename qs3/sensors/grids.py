"""Which pixels of an image give a depth."""

from __future__ import annotations


def on_grid(start: int, count: int, step: int) -> tuple[int, slice]:
    """Every step-th of `count` pixels from `start`, on a grid that does not depend on them.

    Returns:
        The first pixel x >= start with x % step == step // 2, and the slice of the pixels.
    """
    first = start + (step // 2 - start) % step
    return first, slice(first - start, count, step)
