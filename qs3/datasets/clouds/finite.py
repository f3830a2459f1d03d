"""Points that are finite, and fine in float32.

Depth cameras write NaN or infinity where they saw nothing. And a map's coordinates are so far from
their origin that float32 has steps of decimetres there: such clouds are moved before it is used.
"""

from __future__ import annotations

import numpy as np

from qs3.errors import DataError

_MOST = 1e18  # of a coordinate: squares of distances overflow in float32 from about 1e19 on
_FINE = 2.0**-13  # of the cloud, that a step of float32 may be: 0.1 mm of a chair


def measured(cloud: np.ndarray, where: str) -> tuple[np.ndarray, int]:
    """[n, 3] without the points that are NaN or infinite, and how many these were.

    Numbers too large for float32, or for distances in it, stay: `checked` names them.

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

    Where x or y are too far from 0 for float32's steps they are moved there: no classifier sees
    where a cloud lies, but z is its height.

    Raises:
        DataError: no points, a value that is not finite in float32 (above 3.4e38, or NaN), or
            above 1e18, where distances are not; z too far from 0, or numbers that have lost their
            digits already.
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
    if (large := np.abs(small).max(axis=1) > _MOST).any():
        row = int(np.flatnonzero(large)[0])
        raise DataError(
            f"{where}, point {row + 1}: {cloud[row].tolist()} is too far away for distances in "
            "float32; if such numbers stand for no measurement, leave such points out"
        )
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    extent = float((high.astype(np.float64) - low.astype(np.float64)).max())
    step = np.spacing(np.abs(small).max(axis=0))
    coarse = step > _FINE * extent
    if extent == 0 or not coarse.any():
        return small
    lost = cloud.dtype.kind == "f" and cloud.dtype.itemsize < 8
    if lost or coarse[2]:
        axis = 2 if coarse[2] else int(step.argmax())
        keeps = f"{cloud.dtype.name if lost else 'float32'} has steps of {step[axis]:.2g}"
        do = "save it in float64, or subtract" if lost and not coarse[2] else "subtract"
        raise DataError(
            f"{where}: {'xyz'[axis]} is up to {float(np.abs(small[:, axis]).max()):.7g}, where "
            f"{keeps}, and the cloud is only {extent:.3g} large; {do} an offset"
        )
    near = np.asarray(cloud, dtype=np.float64)
    middle = (low.astype(np.float64) + high.astype(np.float64)) / 2
    return (near - np.where(coarse, middle, 0)).astype(np.float32)
