"""A run's clouds as pictures: both domains, their classes, confident errors, one object."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from qs3.report.contact_sheets import class_sheet, contact_sheet, padded, scan_picture
from qs3.report.figures.canvas import NothingToDrawError
from qs3.report.figures.class_balance import class_picture
from qs3.report.runs.data import RunFiles
from qs3.report.runs.domains import domain_of, open_domain, positions_in
from qs3.runs.predictions import Predictions
from qs3.store.store import PointSet
from qs3.utils.plural import counted

ROLES = ("source", "target")
_SHEET, _ROW = 30, 6
"""Clouds on a sheet of mistakes, and in its rows."""


def cloud_pictures(
    run: RunFiles, data_dir: str | Path | None = None
) -> dict[str, Callable[[Path], object]]:
    """What draws each of them into a PNG.

    It raises NothingToDrawError, which says why not, or a Qs3Error of a damaged dataset.

    `data_dir`: where the datasets lie; None: where the run's config says.
    """
    domains = _Domains(run, data_dir)
    makers: dict[str, Callable[[Path], object]] = {
        "domains": domains.side_by_side,
        "source_clouds": partial(domains.sheet, "source"),
        "target_clouds": partial(domains.sheet, "target"),
        "class_balance": domains.balance,
    }
    said = run.predictions
    if said is None or (said.labels >= 0).any():
        makers["mistakes"] = domains.mistakes
    else:
        makers["named"] = domains.named
    return makers


class _Domains:
    """Source and target of a run, opened when first asked for."""

    def __init__(self, run: RunFiles, data_dir: str | Path | None) -> None:
        self.run, self.data_dir = run, data_dir
        self._open: dict[str, PointSet] = {}

    def data(self, role: str) -> PointSet:
        if role not in self._open:
            self._open[role] = open_domain(self.run, role, self.data_dir)
        return self._open[role]

    def label(self, role: str) -> str:
        return f"{role}: {domain_of(self.run, role, self.data_dir).label}"

    def sheet(self, role: str, path: Path) -> None:
        data = self.data(role)
        split = next(iter(data.counts()))
        class_sheet(data, path, split=split, heading=f"{self.label(role)}, {split}")

    def side_by_side(self, path: Path) -> None:
        sets = {role: self.data(role) for role in ROLES}
        for role, data in sets.items():
            if not data.labelled:
                raise NothingToDrawError(f"the {role} has no labels to choose objects by")
        if sets["source"].classes != sets["target"].classes:
            raise NothingToDrawError("the two domains do not have the same classes")
        found = [domain_of(self.run, role, self.data_dir) for role in ROLES]
        titles = [f"{d.symbol}: {d.title}{' (simulated)' * d.simulated}" for d in found]
        if titles[0] == titles[1]:
            titles = [f"{title}, {role}" for title, role in zip(titles, ROLES, strict=True)]
        scan_picture(dict(zip(titles, sets.values(), strict=True)), path)

    def balance(self, path: Path) -> None:
        class_picture({self.label(role): self.data(role) for role in ROLES}, path)

    def mistakes(self, path: Path) -> None:
        """The wrongly named clouds that the result is most confident of; one a mesh."""
        said = self._said()
        wrong = (said.labels >= 0) & (said.predicted != said.labels)
        if not wrong.any():
            raise NothingToDrawError("the result makes no mistake")
        known = f"{counted(wrong.sum(), 'mistake')} in {(said.labels >= 0).sum()} clouds"
        self._sheet_of(said, _surest(said, wrong)[:_SHEET], f"most confident of {known}", path)

    def named(self, path: Path) -> None:
        """Without labels: the clouds that the result is most confident of, a row a class."""
        said = self._said()
        rows = {
            name: _surest(said, said.predicted == k)[:_ROW] for k, name in enumerate(said.classes)
        }
        rows = {name: row for name, row in rows.items() if row}
        shown = [i for row in rows.values() for i in padded(row, _ROW)]
        words = "most confident of each class as predicted"
        self._sheet_of(said, shown, words, path, tuple(rows))

    def _said(self) -> Predictions:
        if self.run.predictions is None:
            raise NothingToDrawError("there are no predictions")
        return self.run.predictions

    def _sheet_of(
        self,
        said: Predictions,
        shown: Sequence[int | None],
        words: str,
        path: Path,
        rows: tuple[str, ...] = (),
    ) -> None:
        data = self.data("target")
        there = [i for i in shown if i is not None]
        place = dict(
            zip(there, positions_in(data, self.run, [said.ids[i] for i in there]), strict=True)
        )

        def title(i: int) -> str:
            named = f"{said.classes[said.predicted[i]]} {said.probabilities[i].max():.2f}"
            return named + (f", is {said.classes[said.labels[i]]}" if said.labels[i] >= 0 else "")

        contact_sheet(
            [None if i is None else np.asarray(data.points[place[i]]) for i in shown],
            ["" if i is None else title(i) for i in shown],
            path,
            columns=_ROW,
            heading=f"{self.label('target')}: {words}",
            rows=rows,
        )


def _surest(said: Predictions, which: np.ndarray) -> list[int]:
    """Positions where `which` [n] holds, the largest probability first, one of each mesh.

    Where a "mesh" has objects of several classes it is a room of an archive: then all of them.
    """
    order = np.argsort(-said.probabilities.max(axis=1), kind="stable")
    kinds = {(mesh, int(label)) for mesh, label in zip(said.meshes, said.labels, strict=True)}
    names = said.meshes if len(kinds) == len({mesh for mesh, _ in kinds}) else said.ids
    found: dict[str, int] = {}
    for i in order[which[order]]:
        found.setdefault(names[i], int(i))
    return list(found.values())
