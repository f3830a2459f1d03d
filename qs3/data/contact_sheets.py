"""Clouds as pictures: contact sheets, and one object of each class in each domain.

A panel is an orthographic view from slightly above, z up, drawn from back to front; colour is
height, and what is farther away is paler. All clouds are scaled to the same size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qs3.data.store import PointSet
from qs3.errors import DataError
from qs3.geometry.orthographic import project
from qs3.utils.files import atomic_path
from qs3.utils.plotting import GRID, INK, PANEL, SOFT, blank, cloud_colours

_PANEL = 1.45  # inches
_DPI = 130


def contact_sheet(
    points: Sequence[np.ndarray | None],
    titles: Sequence[str],
    path: str | Path,
    *,
    columns: int = 6,
    heading: str = "",
    rows: Sequence[str] = (),
) -> Path:
    """Save a sheet of clouds, row by row.

    Args:
        points: clouds [P, 3], z up; None leaves a place empty.
        titles: one a cloud, drawn below it.
        path: of the PNG.
        columns: panels in a row.
        heading: a line above all.
        rows: what stands before each row; none: nothing does.

    Raises:
        DataError: there is nothing to draw.
    """
    if not points or len(points) != len(titles):
        raise DataError(f"a contact sheet of {len(points)} clouds with {len(titles)} titles")
    columns = min(columns, len(points))
    lines = -(-len(points) // columns)
    top, left = (0.45 if heading else 0.1), (0.95 if rows else 0.0)
    figure = _Figure(left + columns * _PANEL, lines * (_PANEL + 0.22) + top)
    for i, (cloud, title) in enumerate(zip(points, titles, strict=True)):
        row, column = divmod(i, columns)
        x, y = left + column * _PANEL, figure.height - top - (row + 1) * (_PANEL + 0.22) + 0.22
        if column == 0 and row < len(rows):
            figure.text(left - 0.1, y + _PANEL / 2, rows[row], size=9, align="right")
        if cloud is not None:
            figure.panel(x, y, cloud)
            figure.text(x + _PANEL / 2, y - 0.06, title, size=7, color=SOFT)
    if heading:
        figure.text(figure.width / 2, figure.height - 0.24, heading, size=11, weight="bold")
    return figure.save(path)


def class_sheet(
    data: PointSet, path: str | Path, *, split: str = "train", heading: str = "", most: int = 60
) -> Path:
    """Save a sheet of a split's clouds: a row a class, or, without labels, from first to last.

    Args:
        data: the domain's.
        path: of the PNG.
        split: which split.
        heading: a line above all.
        most: clouds on the sheet, as long as two of a class fit; six a row. They are taken at
            even steps: scans of one mesh stand side by side in a dataset.

    Raises:
        DataError: the split is empty.
    """
    part, columns = data.split(split), 6
    rows: tuple[str, ...] = ()
    shown: Sequence[int | None]
    if data.labelled:
        columns = max(2, min(columns, most // len(part.classes)))
        members = {cls: _members(part, cls) for cls in part.classes}
        rows = tuple(cls for cls, own in members.items() if len(own))
        shown = [i for cls in rows for i in padded(_evenly(members[cls], columns), columns)]
    else:
        shown = _evenly(np.arange(len(part)), most)
    return contact_sheet(
        [None if i is None else np.asarray(part.points[i]) for i in shown],
        ["" if i is None else short(part.ids[i]) for i in shown],
        path,
        columns=columns,
        heading=heading,
        rows=rows,
    )


def padded(row: Sequence[int], columns: int) -> list[int | None]:
    """A row of a sheet, with empty places at its end."""
    return [*row, *[None] * (columns - len(row))]


def _evenly(members: np.ndarray, most: int) -> list[int]:
    """At most so many of them, at even steps from the first on."""
    few = min(most, len(members))
    return [int(members[i * len(members) // few]) for i in range(few)]


def short(id_: str, letters: int = 22) -> str:
    """The end of an id, as a panel has room for."""
    name = id_.rsplit("/", 1)[-1]
    return name if len(name) <= letters else f"…{name[1 - letters :]}"


def scan_picture(
    domains: Mapping[str, PointSet],
    path: str | Path,
    *,
    split: str = "train",
    blocks: int = 2,
    heading: str = "",
    note: str = "",
) -> Path:
    """Save one object of each class (a row) as each domain has it (a column).

    Where domains share ids (a cloud and its clean twin, surface samples of the same mesh) the
    object is the same; else it is the domain's first of that class.

    Args:
        domains: by column title, such as "S: SpeckleNet10": symbol and words, drawn on two lines.
        path: of the PNG.
        split: which split the objects come from.
        blocks: the classes are set side by side in so many blocks.
        heading: a line above all.
        note: a line below all.

    Raises:
        DataError: no domains, or a domain has no object of the split.
    """
    if not domains:
        raise DataError("a picture of no domains")
    sets = {title: data.split(split) for title, data in domains.items()}
    classes = next(iter(sets.values())).classes
    blocks = min(blocks, len(classes))
    rows = -(-len(classes) // blocks)
    left, gap, top, bottom = 0.95, 0.15, 0.5 + 0.35 * bool(heading), 0.1 + 0.25 * bool(note)
    block = left + len(sets) * _PANEL + gap
    figure = _Figure(blocks * block, rows * _PANEL + top + bottom)
    for i, cls in enumerate(classes):
        x, y = (i // rows) * block, figure.height - top - (i % rows + 1) * _PANEL
        figure.text(x + left - 0.1, y + _PANEL / 2, cls, size=10, align="right")
        for j, cloud in enumerate(_same_object(list(sets.values()), cls)):
            if cloud is None:
                figure.text(x + left + (j + 0.5) * _PANEL, y + _PANEL / 2, "none", color=SOFT)
            else:
                figure.panel(x + left + j * _PANEL, y, cloud)
    for k in range(blocks):
        for j, title in enumerate(sets):
            x = k * block + left + (j + 0.5) * _PANEL
            symbol, _, words = title.rpartition(": ")
            figure.text(x, figure.height - top + 0.29, symbol, size=10, weight="bold")
            figure.text(x, figure.height - top + 0.12, words, size=7.5, color=SOFT)
    if heading:
        figure.text(figure.width / 2, figure.height - 0.26, heading, size=12, weight="bold")
    if note:
        figure.text(figure.width / 2, 0.18, note, size=8, color=SOFT)
    return figure.save(path)


def _same_object(sets: Sequence[PointSet], cls: str) -> list[np.ndarray | None]:
    """A cloud of the class from each set, of the object that most sets have; None if none."""
    ids = [[data.ids[i] for i in _members(data, cls)] for data in sets]
    everywhere = {name: sum(name in own for own in ids) for own in ids for name in own}
    best = max(everywhere, key=lambda name: everywhere[name], default=None)
    found: list[np.ndarray | None] = []
    for data, own in zip(sets, ids, strict=True):
        name = best if best in own else next(iter(own), None)
        found.append(None if name is None else np.asarray(data.points[data.ids.index(name)]))
    return found


def _members(data: PointSet, cls: str) -> np.ndarray:
    known = cls in data.classes
    return np.flatnonzero(data.labels == data.classes.index(cls)) if known else np.array([], int)


class _Figure:
    """A matplotlib figure measured in inches from its lower left corner."""

    def __init__(self, width: float, height: float) -> None:
        self.width, self.height = width, height
        self._figure = blank(width, height, _DPI)

    def panel(self, x: float, y: float, cloud: np.ndarray) -> None:
        """Draw a cloud into the square of one panel whose lower left corner is at x, y."""
        pad = 0.04
        side = _PANEL - 2 * pad
        w, h = self.width, self.height
        box = ((x + pad) / w, (y + pad) / h, side / w, side / h)
        axes: Any = self._figure.add_axes(box, facecolor=PANEL)
        seen, depth, height = project(cloud)
        colour = cloud_colours(height, depth)
        size = float(np.clip(2600 / len(cloud), 0.9, 9.0))
        axes.scatter(*seen.T, s=size, c=colour, linewidths=0)
        axes.set(xlim=(-1.02, 1.02), ylim=(-1.02, 1.02), xticks=[], yticks=[])
        for spine in axes.spines.values():
            spine.set(color=GRID, linewidth=0.6)

    def text(
        self, x: float, y: float, text: str, *, size: float = 9, color: str = INK,
        weight: str = "normal", align: str = "center",
    ) -> None:  # fmt: skip
        """Write a line, vertically centred at y."""
        self._figure.text(
            x / self.width, y / self.height, text, fontsize=size, color=color, fontweight=weight,
            ha=align, va="center",
        )  # fmt: skip

    def save(self, path: str | Path) -> Path:
        """Write the PNG, atomically and without a date in it.

        In 256 colours: that cannot be seen, and a third of the bytes is left. A sheet of 60 clouds
        lies in the folder of each run.
        """
        from PIL import Image

        self._figure.canvas.draw()
        seen = np.asarray(self._figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
        with atomic_path(path) as temporary:
            Image.fromarray(seen).quantize(256).save(temporary, format="png", optimize=True)
        return Path(path)
