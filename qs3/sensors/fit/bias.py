"""What walls at known distances say of a camera's bias."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from qs3.sensors.fit.planes import Wall

_KNOWN = 5e-4  # of a distance: what a good tape or range finder leaves open
_SURE = 2.0  # standard errors that a coefficient is from zero


def find_bias(walls: Sequence[Wall], distances_m: Sequence[float] | None) -> tuple[float, ...]:
    """Polynomial of the error of the wall's distance at the principal point, the constant first.

    A constant, a line or a parabola: a higher power must lower the corrected RMS error by a fifth
    and be two standard errors from none, and there must be more distances than coefficients. A wall
    counts by what noise and the given distance leave open; a slanted one less, for an error of its
    tilt is one of its distance. (0,) without references.
    """
    if distances_m is None:
        return (0.0,)
    true = np.array(distances_m)
    error = np.array([wall.centre_m for wall in walls]) - true
    tilt = np.deg2rad([float(np.median(wall.tilt_deg[wall.region])) for wall in walls])
    open_m = np.hypot(_KNOWN * true, [wall.centre_error_m for wall in walls]) / np.cos(tilt) ** 2
    best, least = np.zeros(1), np.inf
    for degree in range(min(len(np.unique(true)) - 1, 2) + 1):
        design = np.vander(true, degree + 1, increasing=True) / open_m[:, None]
        found = np.linalg.lstsq(design, error / open_m, rcond=None)[0]
        off = error / open_m - design @ found
        free = len(true) - degree - 1
        rms = float(np.sqrt((off**2).sum() / free)) if free else np.inf
        own = float(np.sqrt(np.linalg.inv(design.T @ design)[-1, -1]))
        if degree == 0 or (rms < 0.8 * least and abs(found[-1]) > _SURE * own):
            best, least = found, rms
    return tuple(float(c) for c in best)
