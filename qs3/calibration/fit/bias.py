"""What walls at known distances say of a camera's bias."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import norm as normal
from scipy.stats import t as student

from qs3.calibration.fit.planes import Wall

_KNOWN = 5e-4  # of a distance: what a good tape or range finder leaves open
_SAME = 1e-6  # of a column of the design: what rounding leaves
_SURE = 2.0  # standard errors that a coefficient is from zero


def find_bias(
    walls: Sequence[Wall], distances_m: Sequence[float] | None
) -> tuple[float, ...] | None:
    """Polynomial of the error of the wall's distance at the principal point, the constant first.

    A constant, a line or a parabola: a higher power must lower the corrected RMS error by a fifth
    and be two standard errors from none, by what noise leaves open and by what the walls show (then
    by Student's law); there must be more walls than coefficients, and as many distances. A wall
    counts by what noise and the given distance leave open, which is more where it is slanted. None
    without distances.
    """
    if distances_m is None:
        return None
    true = np.array(distances_m, dtype=float)
    error = np.array([wall.centre_m for wall in walls]) - true
    tilt = np.deg2rad([float(np.median(wall.tilt_deg[wall.region])) for wall in walls])
    given = _KNOWN * true / np.cos(tilt) ** 2
    open_m = np.hypot(given, [wall.centre_error_m for wall in walls])
    best, least = np.zeros(1), np.inf
    for degree in range(min(len(np.unique(true)) - 1, 2) + 1):
        design = np.vander(true, degree + 1, increasing=True) / open_m[:, None]
        q, r = np.linalg.qr(design)
        if abs(r[-1, -1]) < _SAME * np.linalg.norm(design[:, -1]):
            break  # distances that hardly differ
        found = np.linalg.solve(r, q.T @ (error / open_m))
        off = error / open_m - design @ found
        free = len(true) - degree - 1
        rms = float(np.sqrt((off**2).sum() / free)) if free else np.inf
        if degree == 0 or (rms < 0.8 * least and abs(found[-1] * r[-1, -1]) > _surely(rms, free)):
            best, least = found, rms
    return tuple(float(c) for c in best)


def _surely(rms: float, free: int) -> float:
    """How many standard errors of noise alone a coefficient must be from zero.

    Two; where `free` errors are `rms` times what noise makes, as many of theirs as are as rare.
    """
    return _SURE if rms <= 1 else rms * float(student.ppf(normal.cdf(_SURE), free))
