"""Clouds of a stored dataset for the page: evenly chosen, with their views and residuals.

A residual is, of a dataset that was generated with `provenance=true`, how far the sensor's depth
was off; else the distance to the mesh, where that can be made again; else to the nearest point of
the clean twin, whose own spacing is then part of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from qs3.report.contact_sheets import drawn
from qs3.report.inspection.open_dataset import Opened
from qs3.report.inspection.surface import distance_to_mesh, surfaces_of
from qs3.report.viewer.page import Part, Shown
from qs3.store.store import PointSet, open_table

# As `qs3.generation.provenance` writes them, which stands above this package.
_VIEW, _RESIDUAL, _NO_RESIDUAL_M = "view", "residual_m", -99.0


def chosen(data: PointSet, most: int, match: str = "") -> list[int]:
    """Positions of at most so many clouds whose ids hold `match`: as many of each class."""
    there = np.array([match in id_ for id_ in data.ids])
    groups = [data.labels == k for k in np.unique(data.labels)]
    members = [found for group in groups if len(found := np.flatnonzero(group & there))]
    taken: list[int] = []
    for i, own in enumerate(sorted(members, key=len)):  # what small classes leave, others get
        taken += drawn(own, -(-(most - len(taken)) // (len(members) - i)))
    return sorted(taken[:most], key=lambda i: (data.labels[i], i))


def part_of(
    opened: Opened,
    positions: Sequence[int],
    *,
    residuals: bool = True,
    advance: Callable[[], None] = lambda: None,
) -> Part:
    """Clouds of a dataset, in this order.

    Args:
        opened: the dataset.
        positions: of its clouds.
        residuals: also where they must be computed (some tenths of a second a cloud).
        advance: is called after each cloud.
    """
    data, kept = opened.data, opened.kept
    table = _Table(opened)
    truth, words = None, "error of the depth that the sensor measured"
    if table.residual is None:
        truth, words = _truth(opened) if residuals else (None, "")
    shown = []
    for i in positions:
        points = np.asarray(data.points[i], dtype=np.float64)
        label = data.labels[i]
        shown.append(
            Shown(
                data.ids[i],
                points,
                label="" if label < 0 else data.classes[label],
                note=", ".join(filter(None, (kept[i].origin, kept[i].more.get("tier", "")))),
                view=table.views(i),
                residual=table.residuals(i) if truth is None else truth(i, points),
            )
        )
        advance()
    about = f"{len(shown)} of {len(data)} clouds of {opened.label}, made of: {opened.made_of}"
    known = any(one.residual is not None for one in shown)
    return Part(shown, about, opened.unit, words if known else "")


class _Table:
    """What the store's table "provenance" says, if it has one."""

    def __init__(self, opened: Opened) -> None:
        self._table: np.ndarray | None = None
        columns: tuple[str, ...] = ()
        if opened.variant == "points" and "provenance" in opened.data.meta.get("tables", {}):
            self._table, columns = open_table(opened.folder)
        self.view = columns.index(_VIEW) if _VIEW in columns else None
        self.residual = columns.index(_RESIDUAL) if _RESIDUAL in columns else None

    def views(self, i: int) -> Int[np.ndarray, " p"] | None:
        if self._table is None or self.view is None:
            return None
        return np.asarray(self._table[i, :, self.view]).astype(np.int64)

    def residuals(self, i: int) -> Float[np.ndarray, " p"] | None:
        if self._table is None or self.residual is None:
            return None
        off = np.asarray(self._table[i, :, self.residual], dtype=np.float64)
        return np.where(off == _NO_RESIDUAL_M, np.nan, np.abs(off))


def _truth(opened: Opened) -> tuple[Callable[[int, np.ndarray], np.ndarray | None] | None, str]:
    """What gives the distances of a cloud's points to the true surface, and what that is."""
    surfaces, _ = surfaces_of(dict(opened.data.meta))
    kept, twin = opened.kept, opened.twin

    def to_mesh(i: int, points: np.ndarray) -> np.ndarray | None:
        assert surfaces is not None
        mesh = surfaces.mesh(kept[i])
        return None if mesh is None else distance_to_mesh(points, mesh, np.random.default_rng(0))

    def to_twin(i: int, points: np.ndarray) -> np.ndarray:
        assert twin is not None
        return np.asarray(cKDTree(twin.points[i]).query(points)[0])

    if surfaces is not None:
        return to_mesh, "distance to the mesh"
    if twin is not None:
        return to_twin, "distance to the nearest point of the clean twin"
    return None, ""
