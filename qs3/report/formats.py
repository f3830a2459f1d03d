"""A table as text, Markdown and CSV, with the lines that belong below it."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

import pandas as pd

from qs3.report.results import FEW_SEEDS, data_lines
from qs3.report.spec import Metric
from qs3.report.table import INCOMPLETE, Cell, Table
from qs3.utils import text_table
from qs3.utils.files import write_text

METRICS: Mapping[str, str] = {
    name: name.replace("_clean", ", clean").replace("_hard", ", hard").replace("_", " ") + " %"
    for name in get_args(Metric)
}
TO_RUN = "Not run yet, or with fewer seeds than are wanted"
_ACCURACY = "accuracy"  # what papers give, and each run on labels has
_OTHER_DATA = "‡"


def save(at: str | Path, texts: Mapping[str, str]) -> str:
    """Write texts next to each other, by suffix: {".md": ..., ".csv": ...}; returns their names."""
    for suffix, text in texts.items():
        write_text(Path(f"{at}{suffix}"), text)
    return f"saved {at}{', '.join(texts)}"


def grid(table: Table) -> list[list[str]]:
    """The table as strings, header first: a line for our runs, another for published numbers."""
    metrics, columns = table.spec.metrics, [*table.columns, *["average"] * table.spec.averages]
    simulated = {cell.column for cell in table.cells if cell.simulated}

    def head(column: str, metric: str) -> str:
        mark = " (simulated)" * (column in simulated)
        return f"{column}{mark}, {METRICS[metric]}" if len(columns) > 1 else METRICS[metric]

    listed = {row.name: row.average for row in table.spec.rows}
    lines: list[dict[str, str]] = []
    for name, cells in table.rows.items():
        given = [cell for cell in cells if cell.entry.published]
        published = {head(cell.column, _ACCURACY): cell.entry.published for cell in given}
        ours = {
            head(c.column, m): _marked(c.text(m), _is_other(table, c))
            for c in cells
            if c.overrides
            for m in metrics
        }
        if ours and table.spec.averages:
            other = any(_is_other(table, cell) for cell in cells)
            for metric in metrics:
                ours[head("average", metric)] = _marked(table.average(name, metric), other)
        if len(given) == len(table.spec.columns) and table.spec.averages:
            mean = listed[name] or sum(cell.entry.numbers[0] for cell in given) / len(given)
            published[head("average", _ACCURACY)] = f"{mean:.1f}"
        rules = " or ".join(_unique(cell.entry.selected for cell in given))
        of_paper = f"{name}, published{f' (epoch by {rules})' * bool(rules)}"
        lines += [{"method": of_paper} | published] * bool(published)
        lines += [{"method": name} | ours] * bool(ours)
    heads = [head(column, metric) for column in columns for metric in metrics]
    frame = pd.DataFrame(lines, columns=["method", *heads]).dropna(axis=1, how="all").fillna("")
    return [[*frame], *frame.to_numpy().tolist()]


def _unique(values: Iterable[Any]) -> list[Any]:
    return [value for value in dict.fromkeys(values) if value]


def _marked(words: str, other: bool) -> str:
    return f"{words} {_OTHER_DATA}" if words and other else words


def _is_other(table: Table, cell: Cell) -> bool:
    """Whether a column has published figures, and the cell's runs saw data that are not theirs."""
    return not cell.runs.finished.published.all() and any(
        other.entry.published for other in table.cells if other.column == cell.column
    )


def marks(table: Table) -> list[str]:
    """What must not be overlooked: simulated targets, other data, other meshes, failed seeds."""
    lines = []
    if names := _unique(cell.target for cell in table.cells if cell.simulated):
        lines.append(f"SIMULATED target: {', '.join(names)}")
    if any(_is_other(table, cell) for cell in table.cells):
        lines.append(
            f"{_OTHER_DATA} not the data of the published figures: not to be compared with them"
        )
    for column, runs in table.lines.groupby("column", sort=False):
        if runs.meshes[runs.meshes != ""].nunique() > 1:
            lines.append(f"{column}: sources were generated from different meshes")
    problems = [
        f"{cell.row}, {cell.column}: {p}" for cell in table.cells for p in cell.runs.problems
    ]
    if problems:
        lines.append(f"{INCOMPLETE} seeds that failed, are not finished or do not fit")
    return [*lines, *_unique(problems)]


def remarks(table: Table) -> list[str]:
    """The lines below a table: what it is measured on, how models were chosen, who published."""
    runs = table.lines
    lines = [*marks(table), *table.notes, *data_lines(runs)]
    if len(runs):
        for target, some in runs.groupby("target", sort=False):
            rates = _unique(f"{100 * rate:.1f} %" for rate in some.majority_rate.dropna())
            lines.append(f"majority rate of {target}: {' or '.join(rates) or 'not known'}")
        rules = (
            f"{role} selected by {', '.join(_unique(runs[f'{role}_selected']))}"
            for role in ("teacher", "student")
        )
        lines.append(f"{'; '.join(rules)}; mean ± SEM over seeds, n of fewer than {FEW_SEEDS}")
    published = [cell for cell in table.cells if cell.entry.published]
    for source in _unique(cell.entry.source for cell in published):
        rows = _unique(cell.row for cell in published if cell.entry.source == source)
        lines.append(f"published numbers of {', '.join(rows)}: {source}")
    return _unique(lines)


def to_run(table: Table) -> list[str]:
    """Commands that fill the cells without a number or with few seeds, each once.

    By the accuracy, which every run on labels has: no command brings a tier that a target lacks.
    """
    found = []
    for cell in table.cells:
        stat, done = cell.runs.stat(_ACCURACY), cell.runs.finished
        if (stat is None or stat.n < len(cell.seeds)) and (done.empty or done.labelled.any()):
            found.append(cell.command)
    return _unique(found)


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


def csv_text(table: Table) -> str:
    """A line a cell and metric, in percent, with the command and what is wrong."""
    lines = []
    for cell in table.cells:
        if not (cell.overrides or cell.entry.published):
            continue
        first = cell.runs.finished.iloc[0] if cell.runs.seeds else {}
        for metric in table.spec.metrics:
            stat = cell.runs.stat(metric)
            lines.append({
                "row": cell.row,
                "column": cell.column,
                "metric": METRICS[metric].removesuffix(" %"),
                "mean": 100 * stat.mean if stat else None,
                "sem": 100 * stat.sem if stat and stat.sem is not None else None,
                "seeds": " ".join(map(str, cell.runs.seeds)),
                "paper": cell.entry.published if metric == _ACCURACY else None,
                "paper_selected": cell.entry.selected,
                "target": cell.target,
                "simulated": str(cell.simulated).lower() if cell.target else None,
                "teacher_selected": first.get("teacher_selected"),
                "student_selected": first.get("student_selected"),
                "problems": "; ".join(cell.runs.problems),
                "command": cell.command,
            })  # fmt: skip
    return pd.DataFrame(lines).to_csv(index=False, lineterminator="\n")
