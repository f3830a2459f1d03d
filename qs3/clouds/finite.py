"""Points that are finite: depth cameras write NaN or infinity where they saw nothing."""

from __future__ import annotations

import numpy as np

from qs3.errors import DataError


def measured(cloud: np.ndarray, where: str) -> tuple[np.ndarray, int]:
    """[n, 3] without the points that are NaN or infinite, and how many these were.

    Numbers too large for float32 stay: `checked` names them.

    Raises:
        DataError: no point is left.
    """
    finite = np.isfinite(cloud).all(axis=1)
    if finite.all():
        return cloud, 0
    if not finite.any():
        them = f"all {len(cloud)} points are" if len(cloud) > 1 else "its only point is"
        raise DataError(f"{where}: {them} not finite (NaN or infinite)")
    return cloud[finite], int((~finite).sum())


def checked(cloud: np.ndarray, where: str) -> np.ndarray:
    """[n, 3] of any numbers to float32.

    Raises:
        DataError: no points, or a value that is not finite in float32 (above 3.4e38, or NaN).
    """
    if len(cloud) == 0:
        raise DataError(f"{where}: there are no points")
    with np.errstate(over="ignore"):  # becomes infinite, and is reported as such
        small = np.asarray(cloud, dtype=np.float32)
    if not (finite := np.isfinite(small).all(axis=1)).all():
        row = int(np.flatnonzero(~finite)[0])
        raise DataError(
            f"{where}, point {row + 1}: {cloud[row].tolist()} is not finite in float32; "
            "leave such points out"
        )
    return small
