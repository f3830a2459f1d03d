"""A table as text, Markdown, LaTeX (booktabs) and CSV, with the lines that belong below it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from qs3.report.tables.results import FEW_SEEDS, data_lines
from qs3.report.tables.spec import Metric
from qs3.report.tables.table import INCOMPLETE, METRICS, OTHER_DATA, Cell, Table
from qs3.utils import text_table
from qs3.utils.files import write_text

_ACCURACY: Metric = "accuracy"  # what papers give, and each run on labels has
TO_RUN = "Not run yet, or with fewer seeds than are wanted"
_RULES = {"source_val": "source validation", "last": "last epoch"}
_SIGNS = {"±": r"$\pm$", "→": r"$\rightarrow$", OTHER_DATA: r"$\ddagger$", INCOMPLETE: r"$\dagger$"}


def save(at: str | Path, texts: Mapping[str, str]) -> str:
    """Write texts next to each other, by suffix: {".md": ..., ".csv": ...}; returns their names."""
    for suffix, text in texts.items():
        write_text(Path(f"{at}{suffix}"), text)
    return f"saved {at}{', '.join(texts)}"


def grid(table: Table) -> list[list[str]]:
    """The table as strings, header first.

    Published numbers stand next to ours; in a benchmark on a line of their own.
    """
    return _benchmark_grid(table) if table.benchmark else _plain_grid(table)


def _plain_grid(table: Table) -> list[list[str]]:
    many = len(table.columns) > 1
    header = ["method"]
    has_paper = [
        any(cell and cell.paper for cell in of) for of in zip(*table.rows.values(), strict=True)
    ]
    for i, column in enumerate(table.columns):
        if not table.ours(i):
            header.append(f"{column}, published {METRICS[_ACCURACY]}")
            continue
        of_paper = "paper" if _ACCURACY in table.metrics else f"paper, {METRICS[_ACCURACY]}"
        header += _heads(table, i, many) + [of_paper] * has_paper[i]
    lines = [[*header, *["seeds"] * (not many)]]
    for name, cells in table.rows.items():
        line = [name]
        for i, cell in enumerate(cells):
            paper = cell.paper if cell else ""
            if not table.ours(i):
                line.append(f"{paper} ({cell.entry.selected})" if cell and paper else "")
                continue
            line += _ours(table, cell) + [paper] * has_paper[i]
        if not many:
            seeds = cells[0].runs.seeds if cells[0] and cells[0].runs else []
            line.append(", ".join(map(str, seeds)) or "-")
        lines.append(line)
    return lines


def _heads(table: Table, column: int, named: bool) -> list[str]:
    mark = " (simulated)" if table.simulated(column) else ""
    name = f"{table.columns[column]}{mark}"
    if table.benchmark and len(table.metrics) == 1:
        return [name]
    return [f"{name}, {METRICS[m]}" if named else f"{METRICS[m]}{mark}" for m in table.metrics]


def _benchmark_grid(table: Table) -> list[list[str]]:
    """With the rule by which the epoch was chosen."""
    header = ["method", "by"]
    for i in range(len(table.columns)):
        header += _heads(table, i, True)
    header += [f"average {METRICS[m]}" for m in table.metrics]
    lines = [[*header, "epoch selected by"]]
    for name, cells in table.rows.items():
        papers = [cell.paper if cell else "" for cell in cells]
        if any(papers) and _ACCURACY in table.metrics:
            line = [name, "published"]
            for paper in [*papers, table.published_average(name)]:
                line += [paper if m == _ACCURACY else "" for m in table.metrics]
            rules = _unique(c.entry.selected for c in cells if c and c.paper)
            lines.append([*line, " or ".join(rules)])
        if any(cell and cell.runnable for cell in cells):
            line = [name, "ours", *(text for cell in cells for text in _ours(table, cell))]
            other = any(_is_other(table, cell) for cell in cells)
            line += [_marked(table.average_text(name, metric), other) for metric in table.metrics]
            rules = _unique(
                r for c in cells if c and c.runs for r in c.runs.finished.student_selected
            )
            lines.append([*line, " or ".join(_RULES.get(rule, rule) for rule in rules)])
    return lines


def _unique(values: Iterable[Any]) -> list[Any]:
    return [value for value in dict.fromkeys(values) if value]


def _ours(table: Table, cell: Cell | None) -> list[str]:
    """Our figures of a cell, by metric."""
    other = _is_other(table, cell)
    return [_marked(cell.text(m) if cell else "", other) for m in table.metrics]


def _marked(text: str, other: bool) -> str:
    return f"{text} {OTHER_DATA}" if other and text else text


def _is_other(table: Table, cell: Cell | None) -> bool:
    """Whether a column has published figures, and the cell's runs saw data that are not theirs."""
    return bool(
        cell
        and cell.runs
        and not cell.runs.finished.published.all()
        and any(other.paper for other in table.cells if other.column == cell.column)
    )


def marks(table: Table) -> list[str]:
    """What must not be overlooked: other data than published figures have, seeds that failed."""
    lines = []
    if any(_is_other(table, cell) for cell in table.cells):
        lines.append(
            f"{OTHER_DATA} not the data of the published figures: not to be compared with them"
        )
    if any(cell.incomplete for cell in table.cells):
        lines.append(f"{INCOMPLETE} seeds that failed, are not finished or do not fit")
    return [*lines, *problems_of(table)]


def simulated(table: Table) -> list[str]:
    """A line that names simulated targets, if there are some."""
    names = _unique(name for i in range(len(table.columns)) for name in table.simulated(i))
    return [f"SIMULATED target: {', '.join(names)}"] if names else []


def problems_of(table: Table) -> list[str]:
    """What is wrong with cells' runs, each once."""
    return _unique(
        f"{cell.row}, {cell.column}: {said}"
        for cell in table.cells
        if cell.runs
        for said in cell.runs.problems
    )


def remarks(table: Table) -> list[str]:
    """The lines below a table: what it is measured on, how models were chosen, who published."""
    runs = table.lines
    lines = [*simulated(table), *marks(table), *table.notes]
    if len(runs):
        lines += data_lines(runs)
        for target, some in runs.groupby("target", sort=False):
            rates = _unique(f"{100 * rate:.1f} %" for rate in some.majority_rate.dropna())
            lines.append(f"majority rate of {target}: {' or '.join(rates) or 'not known'}")
        rules = (
            f"{role} selected by {', '.join(_unique(runs[f'{role}_selected']))}"
            for role in ("teacher", "student")
        )
        lines.append(f"{'; '.join(rules)}; mean ± SEM over seeds, n of fewer than {FEW_SEEDS}")
    for source in _unique(cell.entry.source for cell in table.cells if cell.paper):
        rows = _unique(c.row for c in table.cells if c.paper and c.entry.source == source)
        lines.append(f"published numbers of {', '.join(rows)}: {source}")
    return _unique(lines)


def to_run(table: Table) -> list[str]:
    """Commands that fill the cells without a number or with few seeds, each once.

    By the accuracy, which every run on labels has: no command brings a tier that a target lacks.
    """
    return _unique(
        cell.command
        for cell in table.cells
        if cell.runnable
        and ((stat := cell.ours(_ACCURACY)) is None or stat.n < len(cell.seeds))
        and not (cell.runs and cell.finished and not cell.runs.finished.labelled.any())
    )


def text(table: Table) -> str:
    """For a terminal: the title, the table, what must not be overlooked, and the file's notes."""
    lines = [table.title, "", *text_table.aligned(grid(table)), "", *marks(table), *table.notes]
    return "\n".join(lines) + "\n"


def markdown(table: Table) -> str:
    """Title, table, remarks, and the commands of what is not run."""
    rows = [[cell.replace("*", r"\*") for cell in line] for line in grid(table)]
    lines = [f"## {table.title}", "", *text_table.markdown(rows)]
    lines += ["", *(f"- {remark}" for remark in remarks(table))]
    if commands := to_run(table):
        lines += ["", f"{TO_RUN}:", "", "```", *commands, "```"]
    return "\n".join(lines) + "\n"


def latex(table: Table) -> str:
    """A booktabs tabular; remarks as comments."""
    header, *body = grid(table)
    notes = [table.title, r"\usepackage{booktabs}", *remarks(table)]
    found = pd.DataFrame(body, columns=header).to_latex(index=False, escape=True)
    for sign, command in _SIGNS.items():
        found = found.replace(sign, command)
    return "".join(f"% {' '.join(note.split())}\n" for note in notes) + found


def csv_text(table: Table) -> str:
    """A line a cell and metric, in percent, with the command and what is wrong."""
    lines = []
    for cell in table.cells:
        first = cell.runs.first if cell.runs else None
        known: Mapping[str, Any] = {} if first is None else first
        for metric in table.metrics:
            stat = cell.ours(metric)
            lines.append({
                "row": cell.row,
                "column": cell.column,
                "metric": METRICS[metric].removesuffix(" %"),
                "mean": 100 * stat.mean if stat else None,
                "sem": 100 * stat.sem if stat and stat.sem is not None else None,
                "seeds": " ".join(map(str, cell.runs.seeds)) if cell.runs else "",
                "paper": cell.paper if metric == _ACCURACY else None,
                "paper_selected": cell.entry.selected,
                "target": cell.target,
                "simulated": str(cell.simulated).lower() if cell.target else None,
                "teacher_selected": known.get("teacher_selected"),
                "student_selected": known.get("student_selected"),
                "problems": "; ".join(cell.runs.problems) if cell.runs else "",
                "command": cell.command,
            })  # fmt: skip
    return pd.DataFrame(lines).to_csv(index=False, lineterminator="\n")
