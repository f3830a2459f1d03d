"""Rows of a table against one of them, and main effects: paired differences with intervals.

Both rows are judged on the same clouds with the same seeds, so a difference is a mean over pairs,
with an interval over seeds and over what test clouds share (`qs3.report.intervals`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from qs3.datasets.object_archive import TIERS
from qs3.errors import ConfigError, DataError
from qs3.report.intervals import LEVEL, Interval, difference
from qs3.report.tables.formats import marks, simulated
from qs3.report.tables.results import CLOUDS, MESHES, answers_of, data_lines, same_data
from qs3.report.tables.spec import chosen
from qs3.report.tables.table import Cell, Table
from qs3.utils import text_table

ALL = "all"
Pair = tuple[Interval, Interval]
"""The differences in accuracy and in balanced accuracy."""


@dataclass(frozen=True)
class Compared:
    """A difference between cells.

    Attributes:
        name: of the row, and of the column if there are several.
        subsets: the differences of all clouds, then of each tier; empty if `why` says what is
            missing.
        why: "" or the reason.
        clusters: what clouds of one cluster share, see `results.MESHES`.
    """

    name: str
    subsets: Mapping[str, Pair] = field(default_factory=dict)
    why: str = ""
    clusters: str = MESHES


def row_of(table: Table, word: str) -> str:
    """The one row that a word means.

    Raises:
        ConfigError: none or several.
    """
    meant = chosen(table.rows, [word], f"table {table.name}, base: ")
    if len(meant) > 1:
        raise ConfigError(f"base={word} may be {' or '.join(map(repr, meant))}")
    return meant[0]


def against(table: Table, base: str, *, reverse: bool = False) -> list[Compared]:
    """Each other row minus the row `base`, column by column; with `reverse` the row minus each."""
    base = row_of(table, base)
    found = []
    for row, cells in table.rows.items():
        for column, cell, own in zip(table.columns, cells, table.rows[base], strict=True):
            if row != base and cell and own and cell.runnable:
                name = f"{row}, {column}" if len(table.columns) > 1 else row
                found.append(_compared(name, [(own, cell) if reverse else (cell, own)]))
    return found


def effects(table: Table) -> list[Compared]:
    """Main effects of a table whose rows cross factors: each level minus the factor's first.

    Over rows with equal levels of the other factors. Levels come in the order of the rows, and
    cells of all columns are pairs of their own.
    """
    levels = pd.DataFrame.from_dict(table.factors, orient="index")
    found = []
    for factor in levels:
        others = levels.drop(columns=factor).apply(tuple, axis=1)
        base, *rest = levels[factor].unique()
        first = {others[row]: row for row in levels.index[levels[factor] == base]}
        for level in rest:
            both: dict[str, tuple[Cell, Cell]] = {}
            for row in levels.index[levels[factor] == level]:
                if others[row] not in first:
                    continue
                pairs = zip(
                    table.columns, table.rows[row], table.rows[first[others[row]]], strict=True
                )
                for column, one, two in pairs:
                    if one and two and one.runnable and two.runnable:
                        where = (*others[row], *[column] * (len(table.columns) > 1))
                        both[", ".join(where)] = one, two
            if both:
                title = f"{factor}: {level} minus {base}, over {'; '.join(both)}"
                found.append(_compared(title, list(both.values())))
    return found


def _same(one: Cell, two: Cell) -> bool:
    """Whether two cells are one experiment, however their overrides are written."""
    first = [cell.runs.first for cell in (one, two) if cell.runs]
    if len(first) == 2 and first[0] is not None and first[1] is not None:
        return bool(first[0].hash == first[1].hash and first[0].experiment == first[1].experiment)
    return one.overrides == two.overrides


def _compared(name: str, pairs: Sequence[tuple[Cell, Cell]]) -> Compared:
    """The mean difference of pairs of cells, or why there is none.

    The rows are taken as given: the interval is over seeds and clusters, as for one pair.
    """
    cells = [cell for pair in pairs for cell in pair]
    try:
        found = _why_not(cells) or _difference(cells)
    except DataError as error:
        found = str(error)
    return Compared(name, why=found) if isinstance(found, str) else Compared(name, *found)


def _seeds(cells: Sequence[Cell]) -> list[int]:
    """Those that all cells have."""
    return sorted(set.intersection(*({*cell.runs.seeds} for cell in cells if cell.runs)))


def _why_not(cells: Sequence[Cell]) -> str:
    """Why cells cannot be compared, as far as it is known without their predictions."""
    if any(cell.entry.take != "final" for cell in cells):
        return "a warm-up's predictions are not kept"
    if lacking := [cell for cell in cells if not cell.finished]:
        return "; ".join(f"{cell.row}, {cell.column}: not run" for cell in lacking)
    if len(seeds := _seeds(cells)) < 2:
        return f"fewer than two seeds in common ({', '.join(map(str, seeds)) or 'none'})"
    if not all(cell.runs.comparable for cell in cells if cell.runs):
        return "not averaged, see the table"
    if all(_same(one, two) for one, two in zip(cells[::2], cells[1::2], strict=True)):
        return "the same runs: their settings do not differ"
    runs = pd.concat([cell.runs.finished for cell in cells if cell.runs])
    if not same_data(runs, "target_data"):
        seen = (f"{r.target} {r.target_data[:12]}" for r in runs.itertuples())
        return f"the runs saw different targets: {' and '.join(dict.fromkeys(seen))}"
    return ""


def _difference(cells: Sequence[Cell]) -> tuple[dict[str, Pair], str, str] | str:
    """`Compared.subsets`, `why` and `clusters`, or why there are none."""
    seeds = _seeds(cells)
    lines = [
        cell.runs.finished.set_index("seed", drop=False).loc[seeds] for cell in cells if cell.runs
    ]
    answers = [[answers_of(run) for run in some.to_dict("records")] for some in lines]
    first = answers[0][0]
    same = (first.clouds == one.clouds for row in answers for one in row)
    if not all(same) or (first.labels < 0).any():
        return "the runs were evaluated on different clouds, or on clouds without labels"
    right = [np.stack([one.called == one.labels for one in row]).astype(float) for row in answers]
    values = np.mean([a - b for a, b in zip(right[::2], right[1::2], strict=True)], axis=0)
    tiers = {tier: first.tiers == tier for tier in TIERS if (first.tiers == tier).any()}
    subsets = {}
    for subset, of in {ALL: np.ones(len(first.labels), dtype=bool), **tiers}.items():
        some = (values[:, of], first.labels[of], first.clusters[of])
        pair = difference(*some), difference(*some, balanced=True)
        if pair[0].low is not None:
            subsets[subset] = pair
    if not subsets:
        return f"a comparison needs test clouds of at least two {first.clusters_are}"
    return subsets, "", first.clusters_are


def text(
    found: Sequence[Compared], base: str = "", markdown: bool = False, table: Table | None = None
) -> str:
    """A line a row: differences in percentage points, and how many seeds would tell them apart.

    Args:
        found: of `against` (with its `base`) or `effects`.
        markdown: instead of columns for the terminal.
        table: that they are of: its title and what must not be overlooked come first.
    """
    tiers = any(len(one.subsets) > 1 for one in found)
    header = [f"minus {base}" if base else "difference", *["clouds"] * tiers]
    rows = [[*header, "accuracy", "balanced accuracy", "seeds", "to tell apart"]]
    for one in found:
        for subset, (accuracy, balanced) in one.subsets.items():
            shown = [f"{d.percent('+')}{' *' * d.clear}" for d in (accuracy, balanced)]
            seeds = [str(accuracy.seeds), _needed(one, accuracy)]
            rows.append([one.name, *[subset] * tiers, *shown, *seeds])
    known = [one for one in found if one.subsets]
    clusters = " or ".join(dict.fromkeys(one.clusters for one in known)) or MESHES
    counts = sorted({next(iter(one.subsets.values()))[0].clusters for one in known})
    notes = [
        f"differences in percentage points with {LEVEL:.0%} intervals over seeds and test "
        f"{clusters} ({', '.join(map(str, counts))}); * marks those that do not reach 0, each "
        "line by itself: of twenty rows that are no better one gets a star"
    ]
    if any(one.clusters == CLOUDS for one in known):
        notes.append("the clouds' objects are not known: if some share one, intervals are narrow")
    whys = dict.fromkeys(one.why for one in found if one.why)
    notes += [f"{', '.join(o.name for o in found if o.why == why)}: {why}" for why in whys]
    head = []
    if table:
        head = [f"{'## ' * markdown}{table.title}", "", *simulated(table), *marks(table), ""]
        notes += data_lines(table.lines)
    layout = text_table.markdown if markdown else text_table.aligned
    body = layout(rows) if len(rows) > 1 else []
    return "\n".join([*head, *body, "", *(f"- {note}" for note in notes)]) + "\n"


def _needed(one: Compared, d: Interval) -> str:
    if d.clear:
        return "-"
    return f"more {one.clusters}" if d.seeds_needed is None else f"{d.seeds_needed} seeds"
