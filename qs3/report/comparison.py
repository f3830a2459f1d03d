"""All rows of a table against one of them: differences with their intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from qs3.errors import ConfigError, DataError
from qs3.predictions import FILE, Predictions, read_predictions
from qs3.report.aggregate import align
from qs3.report.paired import LEVEL, Difference, compare, compare_on_average
from qs3.report.tables import Cell, Table


@dataclass(frozen=True)
class Compared:
    """A cell against the base's cell of the same column.

    Attributes:
        name: of the row, and of the column if there are several.
        differences: accuracy, balanced accuracy; None if `why` says what is missing.
        why: "" or the reason.
    """

    name: str
    differences: tuple[Difference, Difference] | None
    why: str = ""


def against(table: Table, base: str) -> list[Compared]:
    """Each other row minus the row `base`, column by column.

    Raises:
        ConfigError: there is no such row.
    """
    if base not in table.rows:
        raise ConfigError(
            f"table {table.name} has no row {base!r}; rows are {', '.join(map(repr, table.rows))}"
        )
    found = []
    for row, cells in table.rows.items():
        if row == base:
            continue
        for column, cell, other in zip(table.columns, cells, table.rows[base], strict=True):
            if cell is None or other is None or not cell.runnable:
                continue
            name = f"{row}, {column}" if len(table.columns) > 1 else row
            found.append(_compared(name, cell, other))
    return found


def _compared(name: str, cell: Cell, base: Cell) -> Compared:
    if cell.take != "final" or base.take != "final":
        return Compared(name, None, "a warm-up's predictions are not kept")
    ours = {run.seed: run for run in cell.group.finished} if cell.group else {}
    theirs = {run.seed: run for run in base.group.finished} if base.group else {}
    seeds = sorted(seed for seed in ours.keys() & theirs.keys() if seed is not None)
    if len(seeds) < 2:
        return Compared(name, None, f"fewer than two seeds in common ({seeds})")
    try:
        a = [read_predictions(ours[seed].folder / FILE) for seed in seeds]
        b = [read_predictions(theirs[seed].folder / FILE) for seed in seeds]
        return Compared(name, _both(a, b))
    except DataError as error:
        return Compared(name, None, str(error))


def _both(a: Sequence[Predictions], b: Sequence[Predictions]) -> tuple[Difference, Difference]:
    return compare(a, b), compare(a, b, balanced=True)


def effects(table: Table) -> list[Compared]:
    """Main effects: each column minus the first over the rows that have both, then rows likewise.

    Rows whose two cells are one run (a teacher that no column changes) are left out.
    """
    columns = {
        name: [cells[i] for cells in table.rows.values()] for i, name in enumerate(table.columns)
    }
    by_row = {name: list(cells) for name, cells in table.rows.items()}
    return [
        *_main_effects(columns, list(table.rows)),
        *_main_effects(by_row, list(table.columns)),
    ]


def _main_effects(
    lines: Mapping[str, Sequence[Cell | None]], others: Sequence[str]
) -> list[Compared]:
    """Each line of cells minus the first one, over the others that both have."""
    (base, base_cells), *rest = lines.items()
    found = []
    for name, cells in rest:
        both = {
            other: (one, two)
            for other, one, two in zip(others, cells, base_cells, strict=True)
            if one and two and one.runnable and two.runnable and one.overrides != two.overrides
        }
        if both:
            title = f"{name} minus {base}, over {', '.join(both)}"
            found.append(_on_average(title, list(both.values())))
    return found


def _on_average(name: str, cells: Sequence[tuple[Cell, Cell]]) -> Compared:
    if any(cell.take != "final" for pair in cells for cell in pair):
        return Compared(name, None, "a warm-up's predictions are not kept")
    finished = [
        {run.seed: run for run in cell.group.finished} if cell.group else {}
        for pair in cells
        for cell in pair
    ]
    seeds = sorted(seed for seed in set.intersection(*map(set, finished)) if seed is not None)
    if len(seeds) < 2:
        return Compared(name, None, f"fewer than two seeds in common ({seeds})")
    try:
        said = [[read_predictions(runs[seed].folder / FILE) for seed in seeds] for runs in finished]
        pairs = list(zip(said[::2], said[1::2], strict=True))
        plain = compare_on_average(pairs)
        return Compared(name, (plain, compare_on_average(pairs, balanced=True)))
    except DataError as error:
        return Compared(name, None, str(error))


def text(found: Sequence[Compared], base: str = "", markdown: bool = False) -> str:
    """A line a row: differences in percentage points, and how many seeds would tell them apart.

    Args:
        found: of `against` or `effects`.
        base: the row that all are compared with, if it is one.
        markdown: instead of columns for the terminal.
    """
    header = [
        f"minus {base}" if base else "difference",
        "accuracy",
        "balanced accuracy",
        "seeds",
        "to tell apart",
    ]
    lines, notes = [header], []
    for one in found:
        if one.differences is None:
            notes.append(f"{one.name}: {one.why}")
            continue
        accuracy, balanced = one.differences
        lines.append(
            [one.name, _shown(accuracy), _shown(balanced), str(accuracy.seeds), _needed(accuracy)]
        )
    meshes = {one.differences[0].meshes for one in found if one.differences}
    notes.insert(
        0,
        f"differences in percentage points with {LEVEL:.0%} intervals over seeds and test meshes"
        + (f" ({', '.join(map(str, sorted(meshes)))} meshes)" if meshes else "")
        + "; * marks those whose interval does not reach 0",
    )
    table: Callable[[Sequence[Sequence[str]]], list[str]] = _markdown if markdown else align
    return "\n".join([*table(lines), "", *(f"- {note}" for note in notes)]) + "\n"


def _shown(d: Difference) -> str:
    star = " *" if d.clear else ""
    return f"{100 * d.mean:+.1f} [{100 * d.low:+.1f}, {100 * d.high:+.1f}]{star}"


def _needed(d: Difference) -> str:
    if d.clear:
        return "-"
    return "more meshes" if d.seeds_needed is None else f"{d.seeds_needed} seeds"


def _markdown(lines: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]

    def row(cells: Sequence[str]) -> str:
        return "| " + " | ".join(c.ljust(w) for c, w in zip(cells, widths, strict=True)) + " |"

    rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    return [row(lines[0]), rule, *(row(line) for line in lines[1:])]
