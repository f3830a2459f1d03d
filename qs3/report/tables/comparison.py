"""All rows of a table against one of them: differences with their intervals."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from qs3.datasets.importers.object_archive import TIERS
from qs3.errors import DataError
from qs3.report.clustered import LEVEL
from qs3.report.tables.aggregate import data_differences, data_lines, same_data
from qs3.report.tables.cells import Cell, Table
from qs3.report.tables.formats import SIMULATED, marks, problems_of
from qs3.report.tables.made_of import data_marks, results_of
from qs3.report.tables.overrides import row_of
from qs3.report.tables.paired import Difference, compare_on_average
from qs3.runs.predictions import FILE, Predictions, read_predictions
from qs3.utils import text_table

MESHES, BLOCKS, ROOMS = "meshes", "blocks of frames", "rooms"
_BLOCK = re.compile(r"(?:\w+_)?block\d+")  # as importers of frames call them
ALL = "all"
Pair = tuple[Difference, Difference]
"""The differences in accuracy and in balanced accuracy."""


@dataclass(frozen=True)
class Compared:
    """A cell against the base's cell of the same column.

    Attributes:
        name: of the row, and of the column if there are several.
        differences: accuracy, balanced accuracy; None if `why` says what is missing.
        why: "" or the reason.
        objects_known: whether it is known which clouds show the same object.
        tiers: the differences of the clouds of each tier, where the target has tiers.
        tiers_unknown: the target has tiers, but no predictions say which cloud is of which.
        clusters: what clouds of one cluster share: one of `MESHES`, `BLOCKS`, `ROOMS`.
        made_of: what the row's source, the base's source and the target are made of.
        simulated: whether a target is.
    """

    name: str
    differences: Pair | None
    why: str = ""
    objects_known: bool = True
    tiers: Mapping[str, Pair] = field(default_factory=dict)
    tiers_unknown: bool = False
    clusters: str = MESHES
    made_of: tuple[str, str, str] = ("", "", "")
    simulated: bool = False

    @property
    def subsets(self) -> dict[str, Pair]:
        """The differences of all clouds, then of each tier; empty if there are none."""
        return {} if self.differences is None else {ALL: self.differences, **self.tiers}


def against(table: Table, base: str) -> list[Compared]:
    """Each other row minus the row `base`, column by column.

    Raises:
        ConfigError: there is no such row.
    """
    tiers = _Tiers(table)
    return [_compared(name, [(cell, own)], tiers) for name, cell, own in _beside(table, base)]


def minus_each(table: Table, row: str) -> list[Compared]:
    """The row minus each other row, column by column, where both have runs.

    Raises:
        ConfigError: there is no such row.
    """
    tiers = _Tiers(table)
    return [
        _compared(name, [(own, cell)], tiers)
        for name, cell, own in _beside(table, row)
        if cell.group and own.group
    ]


def _beside(table: Table, base: str) -> list[tuple[str, Cell, Cell]]:
    """Name and cell of each other row and column, and the cell of the row `base` there."""
    base = row_of(table.rows, base, table.name)
    found = []
    for row, cells in table.rows.items():
        if row == base:
            continue
        for column, cell, other in zip(table.columns, cells, table.rows[base], strict=True):
            if cell is None or other is None or not cell.runnable:
                continue
            name = f"{row}, {column}" if len(table.columns) > 1 else row
            found.append((name, cell, other))
    return found


def effects(table: Table) -> list[Compared]:
    """Main effects: each column minus the first over the rows that have both, then rows likewise.

    Rows whose two cells are one run (a teacher that no column changes) are left out. Of a table
    whose rows cross factors: each level minus the factor's first, over rows with equal levels of
    the others.
    """
    if table.factors:
        return _effects_of_factors(table)
    columns = {
        name: [cells[i] for cells in table.rows.values()] for i, name in enumerate(table.columns)
    }
    by_row = {name: list(cells) for name, cells in table.rows.items()}
    tiers = _Tiers(table)
    return [
        *_main_effects(columns, list(table.rows), tiers),
        *_main_effects(by_row, list(table.columns), tiers),
    ]


def _effects_of_factors(table: Table) -> list[Compared]:
    """Levels come in the order of the rows, and cells of all columns are pairs of their own."""
    found, levels_of, tiers = [], table.factors, _Tiers(table)
    for factor in next(iter(levels_of.values())):
        base, *rest = dict.fromkeys(levels[factor] for levels in levels_of.values())
        first = {_others(x, factor): row for row, x in levels_of.items() if x[factor] == base}
        for level in rest:
            both: dict[str, tuple[Cell, Cell]] = {}
            for row, levels in levels_of.items():
                if levels[factor] != level or (other := _others(levels, factor)) not in first:
                    continue
                beside = zip(table.columns, table.rows[row], table.rows[first[other]], strict=True)
                for column, one, two in beside:
                    if one and two and one.runnable and two.runnable:
                        where = (*other, column) if len(table.columns) > 1 else other
                        both[", ".join(where)] = one, two
            if both:
                title = f"{factor}: {level} minus {base}, over {'; '.join(both)}"
                found.append(_compared(title, list(both.values()), tiers))
    return found


def _others(levels: Mapping[str, str], factor: str) -> tuple[str, ...]:
    """The levels of the other factors."""
    return tuple(level for name, level in levels.items() if name != factor)


def _same(one: Cell, two: Cell) -> bool:
    """Whether two cells are one experiment, however their overrides are written."""
    if one.group and two.group:
        return (one.group.experiment, one.group.hash) == (two.group.experiment, two.group.hash)
    return one.overrides == two.overrides


def _main_effects(
    lines: Mapping[str, Sequence[Cell | None]], others: Sequence[str], tiers: _Tiers
) -> list[Compared]:
    """Each line of cells minus the first one, over the others that both have."""
    (base, base_cells), *rest = lines.items()
    found = []
    for name, cells in rest:
        both = {
            other: (one, two)
            for other, one, two in zip(others, cells, base_cells, strict=True)
            if one and two and one.runnable and two.runnable and not _same(one, two)
        }
        if both:
            title = f"{name} minus {base}, over {', '.join(both)}"
            found.append(_compared(title, list(both.values()), tiers))
    return found


class _Tiers:
    """Of which tier each cloud is, by the predictions that say it, whichever run of a table's.

    Runs on one target saw the same clouds, and older ones did not save the tiers. One recipe has
    several content hashes where processors of several kinds have followed it.
    """

    def __init__(self, table: Table) -> None:
        self._runs = [run for c in table.cells if c.group for run in c.group.finished]
        self._known: dict[str, dict[str, str]] = {}

    def __call__(self, targets: Iterable[str], ids: Sequence[str]) -> list[str]:
        """Of each cloud of the target with one of these content hashes; "" where nobody knows."""
        known: dict[str, str] = {}
        for target in targets:
            if target not in self._known:
                self._known[target] = self._of(target)
            known = self._known[target] | known
        return [known.get(id_, "") for id_ in ids]

    def _of(self, target: str) -> dict[str, str]:
        for run in self._runs:
            metrics = run.metrics
            if metrics is None or not metrics.evaluation.tiers or metrics.data.target != target:
                continue
            with contextlib.suppress(DataError):
                said = read_predictions(run.folder / FILE)
                if said.tiers:
                    return dict(zip(said.ids, said.tiers, strict=True))
        return {}


def _compared(name: str, pairs: Sequence[tuple[Cell, Cell]], tiers: _Tiers) -> Compared:
    """The mean difference of pairs of cells, or why there is none."""
    simulated = any(cell.simulated for pair in pairs for cell in pair)
    return replace(_difference(name, pairs, tiers), simulated=simulated)


def _difference(name: str, pairs: Sequence[tuple[Cell, Cell]], tiers: _Tiers) -> Compared:
    cells = [cell for pair in pairs for cell in pair]
    if any(cell.take != "final" for cell in cells):
        return Compared(name, None, "a warm-up's predictions are not kept")
    finished = [
        {run.seed: run for run in cell.group.finished} if cell.group else {} for cell in cells
    ]
    seeds = sorted(seed for seed in set.intersection(*map(set, finished)) if seed is not None)
    if len(seeds) < 2:
        if not all(finished):
            return Compared(name, None, _not_run(pairs))
        return Compared(name, None, f"fewer than two seeds in common ({seeds})")
    for cell in cells:
        if cell.group and not cell.group.comparable:
            return Compared(name, None, f"{cell.row}, {cell.column}: not averaged, see the table")
    every = [runs[seed].metrics for runs in finished for seed in seeds]
    results = [result for result in every if result]
    if all(_same(*pair) for pair in pairs):
        return Compared(name, None, "the same runs: their settings do not differ")
    if not same_data(results, "target"):
        return Compared(name, None, data_differences(results, "target"))
    try:
        said = [[read_predictions(runs[seed].folder / FILE) for seed in seeds] for runs in finished]
        both = list(zip(said[::2], said[1::2], strict=True))
        found = _pair_of(both)
    except DataError as error:
        return Compared(name, None, str(error))
    first, targets = said[0][0], dict.fromkeys(result.data.target for result in results)
    known = tiers(targets, first.ids)
    has_tiers = any(result.evaluation.tiers for result in results)
    return Compared(
        name,
        found,
        objects_known=first.meshes != first.ids,
        tiers=_by_tier(both, known),
        tiers_unknown=has_tiers and not any(known),
        clusters=_clusters(first.meshes, has_tiers),
        made_of=_made_of(cells),
    )


def _not_run(pairs: Sequence[tuple[Cell, Cell]]) -> str:
    """Which cells have no run: of one pair the base's by name, of several all unless none has."""
    cells = [cell for pair in pairs for cell in pair]
    lacking = [cell for cell in cells if not (cell.group and cell.group.finished)]
    alone = len(pairs) == 1 and lacking[0] is cells[0]  # the row that the line is about
    if alone or len(lacking) == len(cells):
        return "not run"
    return f"{'; '.join(f'{cell.row}, {cell.column}' for cell in lacking)}: not run"


def _pair_of(both: Sequence[tuple[Sequence[Predictions], Sequence[Predictions]]]) -> Pair:
    plain, balanced = (compare_on_average(both, balanced=b) for b in (False, True))
    return plain, balanced


def _by_tier(
    both: Sequence[tuple[Sequence[Predictions], Sequence[Predictions]]], tiers: Sequence[str]
) -> dict[str, Pair]:
    """The differences of the clouds of each tier of at least two clusters."""
    found = {}
    for tier in TIERS:
        of = np.array([one == tier for one in tiers])
        some = [tuple([p.of(of) for p in row] for row in pair) for pair in both]
        if of.any() and len(set(some[0][0][0].meshes)) > 1:
            found[tier] = _pair_of(some)  # type: ignore[arg-type]
    return found


def _clusters(names: Sequence[str], of_frames: bool) -> str:
    """What clouds of one cluster share."""
    if all(_BLOCK.fullmatch(name) for name in names):
        return BLOCKS
    return ROOMS if of_frames else MESHES


def _made_of(cells: Sequence[Cell]) -> tuple[str, str, str]:
    """Of the rows', the bases' and all targets' data, each thing once."""

    def said(some: Sequence[Cell], role: str) -> str:
        runs = [result for cell in some if cell.group for result in cell.group.results]
        return "; ".join(dict.fromkeys(str(getattr(run.made_of, role)) for run in runs))

    return said(cells[::2], "source"), said(cells[1::2], "source"), said(cells, "target")


def text(
    found: Sequence[Compared], base: str = "", markdown: bool = False, table: Table | None = None
) -> str:
    """A line a row: differences in percentage points, and how many seeds would tell them apart.

    Args:
        found: of `against` (with its `base`) or `effects`.
        markdown: instead of columns for the terminal.
        table: that they are of: its title and what must not be overlooked come first.
    """
    several = any(one.tiers for one in found)
    lines = [[f"minus {base}" if base else "difference", *(["clouds"] if several else []),
              "accuracy", "balanced accuracy", "seeds", "to tell apart"]]  # fmt: skip
    reasons: dict[str, list[str]] = {}
    judged = [(one, pair[0]) for one in found for pair in one.subsets.values()]
    for one in found:
        if one.differences is None:
            reasons.setdefault(one.why, []).append(one.name)
        for subset, (accuracy, balanced) in one.subsets.items():
            lines.append(
                [one.name, *([subset] if several else []), _shown(accuracy), _shown(balanced),
                 str(accuracy.seeds), _needed(one, accuracy)]
            )  # fmt: skip
    clusters = " or ".join(dict.fromkeys(one.clusters for one, _ in judged)) or MESHES
    counts = sorted({one.differences[0].meshes for one in found if one.differences})
    of = f" ({', '.join(map(str, counts))} {clusters})" if counts else ""
    notes = [
        f"differences in percentage points with {LEVEL:.0%} intervals over seeds and test "
        f"{clusters}{of}; * marks those whose interval does not reach 0, each line by itself: of "
        "twenty rows that are no better than the other one gets a star"
    ]
    if any(not one.objects_known for one in found):
        notes.append(
            "which clouds show the same object is not known, so each counts as one of its own: "
            "where several do, the intervals are too narrow"
        )
    if any(one.tiers_unknown for one in found):
        notes.append(
            f"{' and '.join(TIERS)} clouds are not told apart: these predictions were saved "
            "without tiers"
        )
    notes += [f"{', '.join(names)}: {why}" for why, names in reasons.items()]
    if lacking := dict.fromkeys(one.clusters for one, d in judged if _hopeless(d)):
        more = " or ".join(f"more {name}" for name in lacking)
        notes.append(
            f"{more}: no number of seeds would tell them apart, the test split has too few"
        )
    head = []
    if table:
        # Whatever else is missing: numbers on a simulated target are never shown without the word.
        simulated = [mark for mark in marks(table) if mark.startswith(SIMULATED)]
        head = [f"{'## ' if markdown else ''}{table.title}", "", *simulated, *data_marks(table), ""]
        notes += data_lines(results_of(table))
        notes += problems_of(table)
    layout = text_table.markdown if markdown else text_table.aligned
    body = layout(lines) if len(lines) > 1 else []
    return "\n".join([*head, *body, "", *(f"- {note}" for note in notes)]) + "\n"


def csv_text(found: Sequence[Compared], base: str = "") -> str:
    """A line a difference, metric and tier, in percentage points; `base` as of `text`."""
    rows: list[list[Any]] = [
        ["name", "minus", "clouds", "metric", "difference", "low", "high", "seeds", "clusters",
         "clusters_are", "seeds_needed", "simulated", "source_made_of", "other_source_made_of",
         "target_made_of", "why"]
    ]  # fmt: skip
    metrics = ("accuracy", "balanced accuracy")
    for one in found:
        simulated = str(one.simulated).lower()
        if one.differences is None:
            rows += [
                [one.name, base, ALL, name, *[""] * 7, simulated, *one.made_of, one.why]
                for name in metrics
            ]
        for subset, pair in one.subsets.items():
            for metric, d in zip(metrics, pair, strict=True):
                points = [f"{value:.4f}" for value in _points(d)]
                needed = "" if d.seeds_needed is None else d.seeds_needed
                known = [d.seeds, d.meshes, one.clusters, needed, simulated, *one.made_of, ""]
                rows.append([one.name, base, subset, metric, *points, *known])
    return text_table.csv_text(rows)


def _shown(d: Difference) -> str:
    mean, low, high = _points(d)
    return f"{mean:+.1f} [{low:+.1f}, {high:+.1f}]{' *' if d.clear else ''}"


def _points(d: Difference) -> tuple[float, float, float]:
    """Mean and ends in percentage points: none is beyond 100, whatever two seeds' spread says."""
    return 100 * d.mean, max(100 * d.low, -100.0), min(100 * d.high, 100.0)


def _hopeless(d: Difference) -> bool:
    """Whether no number of seeds would tell the two apart."""
    return not d.clear and d.seeds_needed is None


def _needed(one: Compared, d: Difference) -> str:
    if d.clear:
        return "-"
    return f"more {one.clusters}" if _hopeless(d) else f"{d.seeds_needed} seeds"
