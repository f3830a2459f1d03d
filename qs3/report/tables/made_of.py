"""What the data behind figures are made of: lines for below a table, and marks within it."""

from __future__ import annotations

from collections.abc import Sequence

from qs3.report.tables.cells import Cell, Table
from qs3.runs.metrics import RunMetrics

OTHER_DATA = "‡"
"""Marks a number of ours that stands beside published ones and was not measured on their data."""


def results_of(table: Table) -> list[RunMetrics]:
    """Results of all finished runs of a table, cell by cell."""
    return [result for cell in table.cells if cell.group for result in cell.group.results]


def is_other(table: Table, cell: Cell | None) -> bool:
    """Whether a column has published figures, and the cell's runs saw data that are not theirs."""
    return bool(
        cell
        and cell.group
        and any(other.paper for other in table.cells if other.column == cell.column)
        and any(not m.published for r in cell.group.results for m in r.domains.values())
    )


def data_marks(table: Table) -> list[str]:
    """What must not be overlooked: other data than the published ones; meshes that differ."""
    lines = []
    other = [r for c in table.cells if is_other(table, c) and c.group for r in c.group.results]
    foreign = [
        f"{name} ({made})" for r in other for name, made in r.domains.items() if not made.published
    ]
    if foreign:
        lines.append(
            f"{OTHER_DATA} not the data of the published figures, so not to be compared with them: "
            + "; ".join(dict.fromkeys(foreign))
        )
    by_meshes: dict[str, list[Cell]] = {}
    sources: dict[str, str] = {}
    for cell in table.cells:
        run = cell.group.first if cell.group else None
        if run and run.source != run.target and (digits := run.made_of.source.meshes):
            by_meshes.setdefault(digits, []).append(cell)
            sources.setdefault(digits, f"{run.source} ({run.made_of.source}; meshes {digits})")
    if len(by_meshes) > 1:
        parts = [f"{sources[d]} in {_places(table, cells)}" for d, cells in by_meshes.items()]
        lines.append(f"the sources are made from different meshes: {'; '.join(parts)}")
    return lines


def _places(table: Table, cells: Sequence[Cell]) -> str:
    """Columns, where all that was run of one is meant; else rows, and their columns if several."""
    names = []
    for column in table.columns:
        run = [c for c in table.cells if c.column == column and c.group and c.group.finished]
        ours = [cell for cell in cells if cell.column == column]
        if ours == run and len(table.columns) > 1:
            names.append(column)
        else:
            several = f", {column}" if len(table.columns) > 1 else ""
            names += [f"{cell.row}{several}" for cell in ours]
    return " and ".join(names)
