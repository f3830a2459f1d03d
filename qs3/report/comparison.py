"""Rows of a table against one of them, and main effects: paired differences with intervals.

Both rows are judged on the same clouds with the same seeds, so a difference is a mean over pairs,
with an interval over seeds and over what test clouds share (`qs3.report.intervals`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from qs3.datasets.object_archive import TIERS
from qs3.errors import ConfigError, Qs3Error
from qs3.report.formats import marks
from qs3.report.intervals import LEVEL, Interval, difference
from qs3.report.results import CLOUDS, MESHES, answers_of, data_lines, same_data
from qs3.report.spec import chosen
from qs3.report.table import Cell, Table
from qs3.utils.text_table import aligned

ALL = "all"


@dataclass(frozen=True)
class Compared:
    """A difference between cells.

    `subsets` are the differences in accuracy and in balanced accuracy, of all clouds, then of each
    tier; empty if `why` says what is missing. `clusters`: what clouds of one cluster share, see
    `results.MESHES`.
    """

    name: str
    subsets: Mapping[str, tuple[Interval, Interval]] = field(default_factory=dict)
    why: str = ""
    clusters: str = MESHES


def row_of(table: Table, word: str) -> str:
    """The one row that a word means; a ConfigError for none or several."""
    meant = chosen(table.rows, [word])
    if len(meant) > 1:
        raise ConfigError(f"base={word} may be {' or '.join(map(repr, meant))}")
    return meant[0]


def against(table: Table, base: str, *, reverse: bool = False) -> list[Compared]:
    """Each other row minus the row `base`, column by column; with `reverse` the row minus each."""
    base = row_of(table, base)
    found = []
    for row, cells in table.rows.items():
        for cell, own in zip(cells, table.rows[base], strict=True):
            if row != base and cell.overrides:
                name = f"{row}, {cell.column}" if len(table.columns) > 1 else row
                found.append(_compared(name, [(own, cell) if reverse else (cell, own)]))
    return found


def effects(table: Table) -> list[Compared]:
    """Main effects of a table whose rows cross factors: each level minus the factor's first.

    Over rows with equal levels of the other factors. Levels come in the order of the rows, and
    cells of all columns are pairs of their own.
    """
    factors = {row.name: row.factors for row in table.spec.rows if row.factors}
    levels = pd.DataFrame.from_dict(factors, orient="index")
    found = []
    for factor in levels:
        others = levels.drop(columns=factor).apply(tuple, axis=1)
        base, *rest = levels[factor].unique()
        first = {others[row]: row for row in levels.index[levels[factor] == base]}
        for level in rest:
            both: dict[str, tuple[Cell, Cell]] = {}
            for row in levels.index[(levels[factor] == level) & others.isin([*first])]:
                base_cells = table.rows[first[others[row]]]
                for one, two in zip(table.rows[row], base_cells, strict=True):
                    if one.overrides and two.overrides:
                        where = (*others[row], *[one.column] * (len(table.columns) > 1))
                        both[", ".join(where)] = one, two
            if both:
                title = f"{factor}: {level} minus {base}, over {'; '.join(both)}"
                found.append(_compared(title, list(both.values())))
    return found


def _compared(name: str, pairs: Sequence[tuple[Cell, Cell]]) -> Compared:
    """The mean difference of pairs of cells, or why there is none."""
    cells = [cell for pair in pairs for cell in pair]
    seeds = sorted(set.intersection(*({*cell.runs.seeds} for cell in cells)))
    runs = pd.concat([cell.runs.finished for cell in cells])
    why = ""
    if any(cell.entry.take != "final" for cell in cells):
        why = "a warm-up's predictions are not kept"
    elif lacking := [f"{cell.row}, {cell.column}" for cell in cells if not cell.runs.seeds]:
        why = f"not run: {'; '.join(lacking)}"
    elif len(seeds) < 2:
        why = f"fewer than two seeds in common ({', '.join(map(str, seeds)) or 'none'})"
    elif any(cell.runs.apart for cell in cells):
        why = "not averaged, see the table"
    elif not same_data(runs, "target_data"):
        seen = (f"{r.target} {r.target_data[:12]}" for r in runs.itertuples())
        why = f"the runs saw different targets: {' and '.join(dict.fromkeys(seen))}"
    try:
        return Compared(name, why=why) if why else _difference(name, cells, seeds)
    except Qs3Error as error:
        return Compared(name, why=str(error))


def _difference(name: str, cells: Sequence[Cell], seeds: Sequence[int]) -> Compared:
    """The mean of every other cell less the next one's, over seeds that all have."""
    lines = [cell.runs.finished.set_index("seed", drop=False).loc[seeds] for cell in cells]
    answers = [[answers_of(run) for run in some.to_dict("records")] for some in lines]
    first = answers[0][0]
    if any(one.clouds != first.clouds for row in answers for one in row) or first.labels.min() < 0:
        return Compared(
            name, why="the runs were evaluated on different clouds, or on clouds without labels"
        )
    right = [np.stack([one.called == one.labels for one in row]).astype(float) for row in answers]
    values = np.mean([a - b for a, b in zip(right[::2], right[1::2], strict=True)], axis=0)
    tiers = {tier: first.tiers == tier for tier in TIERS if (first.tiers == tier).any()}
    subsets = {}
    for subset, of in {ALL: np.ones(len(first.labels), dtype=bool), **tiers}.items():
        some = (values[:, of], first.labels[of], first.clusters[of])
        pair = difference(*some), difference(*some, balanced=True)
        if pair[0].low is not None:
            subsets[subset] = pair
    why = "" if subsets else f"a comparison needs test clouds of two {first.clusters_are}"
    return Compared(name, subsets, why, first.clusters_are)


def text(found: Sequence[Compared], base: str = "", table: Table | None = None) -> str:
    """A line a row of `against` (with its `base`) or of `effects`: differences in points of %.

    Of `table` the title and its marks come first.
    """
    tiers = any(len(one.subsets) > 1 for one in found)
    header = [f"minus {base}" if base else "difference", *["clouds"] * tiers]
    rows = [[*header, "accuracy", "balanced accuracy", "seeds"]]
    for one in found:
        for subset, pair in one.subsets.items():
            shown = [f"{d.percent('+')}{' *' * d.clear}" for d in pair]
            rows.append([one.name, *[subset] * tiers, *shown, str(pair[0].seeds)])
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
        head = [table.title, "", *marks(table), ""]
        notes += data_lines(table.lines)
    body = aligned(rows) if len(rows) > 1 else []
    return "\n".join([*head, *body, "", *(f"- {note}" for note in notes)]) + "\n"
