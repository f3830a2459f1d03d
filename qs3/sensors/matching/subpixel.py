"""Where between whole disparities the best match is."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from qs3.errors import ConfigError


class Fit(StrEnum):
    """Curve through the cost of the best disparity and its two neighbours.

    PARABOLA: right where costs grow with the square of the distance (squared differences,
        correlation).
    V: two lines of equal and opposite slope, right where costs grow linearly (absolute
        differences, Hamming distances). Shimizu and Okutomi, IJCV 2005, section 2.
    """

    PARABOLA = "parabola"
    V = "v"

    @classmethod
    def of(cls, name: Fit | str) -> Fit:
        """The fit of this name."""
        try:
            return cls(name)
        except ValueError as error:
            names = " or ".join(fit.value for fit in cls)
            raise ConfigError(f"fit must be {names}, got {name!r}") from error


def offset(lower: np.ndarray, best: np.ndarray, upper: np.ndarray, fit: Fit) -> np.ndarray:
    """Position of the minimum, -0.5..0.5 px from the best towards `upper`; float32.

    0 where all three float32 costs are the same; where `best` is not the lowest, as costs before
    aggregation may be, the nearer end.
    """
    if fit is Fit.PARABOLA:
        width = 2 * (lower + upper - 2 * best)
    else:
        width = 2 * (np.maximum(lower, upper) - best)
    half = np.float32(0.5)
    return np.clip((lower - upper) / np.maximum(width, np.float32(1e-6)), -half, half)


def linearised(phase: np.ndarray, a_factor: float) -> np.ndarray:
    """Undo the pull towards (or away from) whole pixels that a fit has: pixel locking.

    An odd map that keeps -0.5, 0 and 0.5: x + a sin(2 pi x) / (2 pi), with one number for a
    fit and a cost, as the "A-factor" of RealSense D400 cameras (Intel, Subpixel linearity
    improvement; its formula is not published, this one is ours).

    Args:
        phase: from `offset`.
        a_factor: -1..1; > 0 where values crowd at whole pixels, < 0 where at halves.
    """
    if not a_factor:
        return phase
    turn = np.float32(2 * np.pi)
    return phase + np.float32(a_factor) / turn * np.sin(turn * phase)
