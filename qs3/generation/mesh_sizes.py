"""Meshes that are not in metres, where objects keep their size: said before hours of scans.

`RealSize` takes a mesh of a plausible size as it is and makes any other one as large as it takes an
object to be, so that millimetres give a dataset in which all objects are of one size.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.mesh import Mesh
from qs3.meshes.placement import RealSize
from qs3.meshes.source import MeshItem
from qs3.utils.plural import counted

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
    warn_of_lost(placing, [mesh for i in few if (mesh := _read(files[i])) is not None])


def warn_of_lost(placing: object, meshes: Sequence[Mesh]) -> None:
    """A warning if some meshes have a size that `placing` will not keep."""
    if not isinstance(placing, RealSize):
        return
    sides = [float(np.ptp(mesh.bounds, axis=0).max()) for mesh in meshes]
    other = [side for side in sides if not placing.keeps(side)]
    if not other:
        return
    middle, (low, high) = float(np.median(other)), _FURNITURE_M
    unit = next((f" as in {name}" for name, m in _UNITS if low <= middle * m <= high), "")
    log.warning(
        "%d of %s looked at %s a largest side of %.4g to %.4g%s, not of %g to %g m: each is scaled "
        "to %g m, and its size is lost. To keep it, give meshes in metres",
        len(other), counted(len(sides), "mesh", "meshes"), "has" if len(other) == 1 else "have",
        min(other), max(other), unit, placing.min_side_m, placing.max_side_m,
        placing.fallback_side_m,
    )  # fmt: skip


def _read(item: MeshItem) -> Mesh | None:
    """None if it cannot be read, which is said when it is scanned."""
    try:
        return item.load()
    except MeshError:
        return None
