"""Clouds as pictures: contact sheets, and one object of each class in each domain.

A panel is an orthographic view from slightly above, z up, drawn from back to front; colour is
height, and what is farther away is paler. All clouds are scaled to the same size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import DataError
from qs3.geometry.orthographic import project
from qs3.store.store import PointSet
from qs3.utils.files import atomic_path
from qs3.utils.plotting import GRID, INK, PANEL, SOFT, blank, boxes_for_letters, cloud_colours

_PANEL, _TITLE = 1.45, 0.22  # inches
_DPI = 130
_SHEET, _ROW = 60, 6  # clouds of a class sheet, and in its rows


def contact_sheet(
    points: Sequence[np.ndarray | None],
    titles: Sequence[str],
    path: str | Path,
    *,
    columns: int = _ROW,
    heading: str = "",
    rows: Sequence[str] = (),
    heads: Sequence[str] = (),
    note: str = "",
) -> Path:
    """Save a sheet of clouds as a PNG, row by row.

    Args:
        points: clouds [P, 3], z up; None leaves a place empty.
        titles: one a cloud, drawn below it.
        path: of the PNG.
        columns: panels in a row.
        heading, note: a line above all, and one below all.
        rows: what stands before each row, if anything.
        heads: what stands above each column, "symbol: words" on two lines.

    Raises:
        DataError: there is nothing to draw.
    """
    if not points or len(points) != len(titles):
        raise DataError(f"a contact sheet of {len(points)} clouds with {len(titles)} titles")
    columns = min(columns, len(points))
    left, bottom = (0.95 if rows else 0.0), (0.25 if note else 0.0)
    top = (0.45 if heading else 0.1) + (0.35 if heads else 0.0)
    lines = -(-len(points) // columns)
    height = lines * (_PANEL + _TITLE) + top + bottom
    figure = _Figure(left + columns * _PANEL, height)
    for i, (cloud, title) in enumerate(zip(points, titles, strict=True)):
        row, column = divmod(i, columns)
        x, y = left + column * _PANEL, height - top - (row + 1) * (_PANEL + _TITLE) + _TITLE
        if column == 0 and row < len(rows):
            figure.text(left - 0.1, y + _PANEL / 2, rows[row], size=9, align="right")
        if cloud is not None:
            figure.panel(x, y, cloud)
        figure.text(x + _PANEL / 2, y - 0.06, title, size=7, color=SOFT)
    for column, head in enumerate(heads[:columns]):
        symbol, _, words = head.rpartition(": ")
        x = left + (column + 0.5) * _PANEL
        figure.text(x, height - top + 0.25, symbol, size=10, weight="bold")
        figure.text(x, height - top + 0.1, words, size=7.5, color=SOFT)
    if heading:
        figure.text(figure.width / 2, height - 0.24, heading, size=11, weight="bold")
    if note:
        figure.text(figure.width / 2, 0.14, note, size=8, color=SOFT)
    return figure.save(path)


def class_sheet(
    data: PointSet, path: str | Path, *, split: str = "train", heading: str = ""
) -> Path:
    """Save a sheet of up to 60 of a split's clouds, two a class at least.

    A row is a class. They are `drawn`: scans of one mesh are neighbours in a dataset, and families
    of a catalogue take turns.

    Raises:
        DataError: the split is empty.
    """
    part, columns = data.split(split), _ROW
    rows: tuple[str, ...] = ()
    shown: Sequence[int | None]
    if data.labelled:
        columns = max(2, min(columns, _SHEET // len(part.classes)))
        members = {cls: part.members(cls) for cls in part.classes}
        rows = tuple(cls for cls, own in members.items() if len(own))
        shown = [i for cls in rows for i in padded(drawn(members[cls], columns), columns)]
    else:
        shown = drawn(np.arange(len(part)), _SHEET)
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


def short(id_: str) -> str:
    """The end of an id, as a panel has room for."""
    name = id_.rsplit("/", 1)[-1]
    return name if len(name) <= 22 else f"…{name[-21:]}"


def scan_picture(
    domains: Mapping[str, PointSet], path: str | Path, *, split: str = "train", note: str = ""
) -> Path:
    """Save one object of each class as each domain has it, two classes a row.

    Where domains share ids (a cloud and its clean twin, surface samples of the same mesh) the
    object is the same; else it is the domain's first of that class.

    Args:
        domains: by column title, such as "S: SpeckleNet10".
        path: of the PNG.
        split: which split the objects come from.
        note: a line below all.

    Raises:
        DataError: no domains, or a domain has no object of the split.
    """
    if not domains:
        raise DataError("a picture of no domains")
    sets = [data.split(split) for data in domains.values()]
    classes = sets[0].classes
    half = -(-len(classes) // 2)
    order = [cls for i in range(half) for cls in classes[i::half]]
    clouds = {cls: _same_object(sets, cls) for cls in order}
    return contact_sheet(
        [cloud for of in clouds.values() for cloud in of],
        [cls if c is not None else f"no {cls}" for cls, of in clouds.items() for c in of],
        path,
        columns=2 * len(sets),
        heads=[*domains] * 2,
        note=note,
    )


def _same_object(sets: Sequence[PointSet], cls: str) -> list[np.ndarray | None]:
    """A cloud of the class from each set, of the object that most sets have; None if none."""
    ids = [[data.ids[i] for i in data.members(cls)] for data in sets]
    everywhere = {name: sum(name in own for own in ids) for own in ids for name in own}
    best = max(everywhere, key=lambda name: everywhere[name], default=None)
    found: list[np.ndarray | None] = []
    for data, own in zip(sets, ids, strict=True):
        name = best if best in own else next(iter(own), None)
        found.append(None if name is None else np.asarray(data.points[data.ids.index(name)]))
    return found


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
        size = float(np.clip(2600 / len(cloud), 0.9, 9.0))
        axes.scatter(*seen.T, s=size, c=cloud_colours(height, depth), linewidths=0)
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
        """Write the PNG, atomically and without a date, in 256 colours: a third of the bytes."""
        from PIL import Image

        with boxes_for_letters():
            self._figure.canvas.draw()
        seen = np.asarray(self._figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
        with atomic_path(path) as temporary:
            Image.fromarray(seen).quantize(256).save(temporary, format="png", optimize=True)
        return Path(path)


def drawn(positions: np.ndarray, most: int, seed: int = 0) -> list[int]:
    """At most so many of some positions [n], at random, always the same ones, in order."""
    if len(positions) <= most:
        return [int(i) for i in positions]
    return sorted(np.random.default_rng(seed).choice(positions, most, replace=False).tolist())
