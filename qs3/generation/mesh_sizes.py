"""Meshes that are not in metres, where objects keep their size: said before hours of scans.

`RealSize` takes a mesh of a plausible size as it is and makes any other one as large as it takes an
object to be, so that millimetres give a dataset in which all objects are of one size.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.placement import RealSize
from qs3.meshes.source import MeshItem

log = logging.getLogger(__name__)

JUDGED = 20
"""Files that are looked at, evenly over all of them."""

_UNITS = (("millimetres", 1e-3), ("centimetres", 1e-2))
_FURNITURE_M = (0.3, 3.0)  # where the middle of largest sides is


def warn_of_sizes(placing: object, items: Sequence[MeshItem]) -> None:
    """A warning if some files have a size that `placing` will not keep; the embedded do not."""
    files = [item for item in items if item.path]
    if not isinstance(placing, RealSize) or not files:
        return
    few = np.unique(np.linspace(0, len(files) - 1, min(len(files), JUDGED)).round().astype(int))
    sides = np.array([side for i in few if (side := _largest_side(files[i])) is not None])
    other = sides[[not placing.keeps(side) for side in sides]] if len(sides) else sides
    if not len(other):
        return
    middle, (low, high) = float(np.median(other)), _FURNITURE_M
    unit = next((f" as in {name}" for name, m in _UNITS if low <= middle * m <= high), "")
    log.warning(
        "%d of %d meshes that were looked at have a largest side of %.4g to %.4g%s, not of %g to "
        "%g m: each is scaled to %g m, and its size is lost. To keep it, save them in metres",
        len(other), len(sides), other.min(), other.max(), unit, placing.min_side_m,
        placing.max_side_m, placing.fallback_side_m,
    )  # fmt: skip


def _largest_side(item: MeshItem) -> float | None:
    """Of the mesh; None if it cannot be read, which is said when it is scanned."""
    try:
        low, high = item.load().bounds
    except MeshError:
        return None
    return float((high - low).max())
