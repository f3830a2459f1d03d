"""Whether an array can be clouds at all: a depth image and turned rows and columns are not."""

from __future__ import annotations

from typing import Any

from qs3.errors import DataError

_MOST_COLUMNS = 32
"""x y z, normals, colours and what else programs write; a picture has more."""

_FEW = 10
"""More columns are no three points with what is known of each, but as many points in columns."""


def check_shape(where: Any, shape: tuple[int, ...]) -> None:
    """Refuse an array of numbers whose rows can be no points.

    Args:
        where: for the message: its file.
        shape: [n, >= 3], a point a row with perhaps more columns; or [m, n, >= 3], m clouds.

    Raises:
        DataError: turned (x y z are rows), or rather a depth image; begins with `where`.
    """
    rows, columns = shape[-2:]
    told = f"{where}: the array has shape {shape}"
    if (rows == 3 and columns > _FEW) or (rows <= _FEW and columns > _MOST_COLUMNS):
        turn = "array.T" if len(shape) == 2 else "array.transpose(0, 2, 1)"
        raise DataError(f"{told}: is it transposed? A point is a row x y z: save {turn}")
    if columns > _MOST_COLUMNS:
        raise DataError(
            f"{told}: it looks like a depth image, {columns} x {rows} px: give it as depth= with "
            f"mask= or box=; points have at most {_MOST_COLUMNS} columns, x y z first"
        )
