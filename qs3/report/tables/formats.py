"""A table as Markdown, LaTeX (booktabs) and CSV, with the lines that belong below it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from qs3.datasets.object_archive import TIERS
from qs3.report.tables.results import COSTS, FEW_SEEDS, Runs, data_lines, task
from qs3.report.tables.spec import Metric
from qs3.report.tables.table import INCOMPLETE, METRICS, OTHER_DATA, Cell, Table
from qs3.utils import text_table
from qs3.utils.files import write_text

_ACCURACY: Metric = "accuracy"  # what papers give, and each run on labels has
TO_RUN = "Not run yet, or with fewer seeds than are wanted"
_RULES = {"source_val": "source validation", "last": "last epoch"}


def save(at: str | Path, texts: Mapping[str, str]) -> str:
    """Write texts next to each other, by suffix: {".md": ..., ".csv": ...}; returns their names."""
    for suffix, text in texts.items():
        write_text(Path(f"{at}{suffix}"), text)
    return f"saved {at}{', '.join(texts)}"


def grid(table: Table) -> list[list[str]]:
    """The table as strings, header first."""
    return _benchmark_grid(table) if table.benchmark else _plain_grid(table)


def _plain_grid(table: Table) -> list[list[str]]:
    """For each task our metrics, then the paper's if any."""
    many = len(table.columns) > 1
    header = ["method"]
    for i, column in enumerate(table.columns):
        if not table.ours(i):
            header.append(f"{column}, published {METRICS[_ACCURACY]}")
            continue
        of_paper = "paper" if _ACCURACY in table.metrics else f"paper, {METRICS[_ACCURACY]}"
        header += _heads(table, i, many) + [of_paper] * _has_paper(table, i)
    lines = [[*header, *["seeds"] * (not many)]]
    for name, cells in table.rows.items():
        line = [name]
        for i, cell in enumerate(cells):
            paper = cell.paper if cell else ""
            if not table.ours(i):
                line.append(f"{paper} ({cell.entry.selected})" if cell and paper else "")
                continue
            line += _ours(table, cell) + [paper] * _has_paper(table, i)
        if not many:
            seeds = cells[0].runs.seeds if cells[0] and cells[0].runs else []
            line.append(", ".join(map(str, seeds)) or "-")
        lines.append(line)
    return lines


def _heads(table: Table, column: int, named: bool) -> list[str]:
    mark = " (simulated)" if table.simulated(column) else ""
    name = f"{table.columns[column]}{mark}, " if named else ""
    return [f"{name}{METRICS[m]}{'' if named else mark}" for m in table.metrics]


def _benchmark_grid(table: Table) -> list[list[str]]:
    """Published numbers and ours on a line each, with the rule by which the epoch was chosen."""
    header = ["method", "by"]
    for i, column in enumerate(table.columns):
        named = len(table.metrics) > 1
        header += (
            _heads(table, i, True)
            if named
            else [column + " (simulated)" * bool(table.simulated(i))]
        )
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


def _has_paper(table: Table, column: int) -> bool:
    return any((cell := row[column]) and cell.paper for row in table.rows.values())


def marks(table: Table) -> list[str]:
    """What must not be overlooked: simulated targets, other data or meshes, seeds that failed."""
    simulated = _unique(name for i in range(len(table.columns)) for name in table.simulated(i))
    lines = [f"SIMULATED target: {', '.join(simulated)}"] if simulated else []
    other = [cell.runs.finished for cell in table.cells if _is_other(table, cell) and cell.runs]
    if other:
        said = [line.removeprefix("data: ") for line in data_lines(pd.concat(other))]
        lines.append(
            f"{OTHER_DATA} not the data of the published figures, so not to be compared with them: "
            + "; ".join(said)
        )
    runs = table.lines
    sources = runs[runs.meshes != ""].drop_duplicates("meshes") if len(runs) else runs
    if len(sources) > 1:
        made = [f"{r.source} ({r.source_made_of}; meshes {r.meshes})" for r in sources.itertuples()]
        lines.append(f"the sources are made from different meshes: {'; '.join(made)}")
    if any(cell.incomplete for cell in table.cells):
        lines.append(f"{INCOMPLETE} seeds that failed, are not finished or do not fit: see below")
    return lines


def remarks(table: Table) -> list[str]:
    """The lines below a table: what it is measured on, how models were chosen, what is missing."""
    runs = table.lines
    lines = [*marks(table), *table.notes]
    if len(runs):
        lines += data_lines(runs)
        for target, some in runs.groupby("target", sort=False):
            lines.append(f"majority rate of {target}: {_majority(some)}")
        for role in ("teacher", "student"):
            lines.append(f"{role} selected by: {', '.join(_unique(runs[f'{role}_selected']))}")
        counts = runs.groupby(["row", "column"]).size()
        seeds = " to ".join(dict.fromkeys(map(str, (counts.min(), counts.max()))))
        lines.append(f"mean ± standard error over {seeds} seeds; (n=...): fewer than {FEW_SEEDS}")
    for source in _unique(cell.entry.source for cell in table.cells if cell.paper):
        rows = _unique(c.row for c in table.cells if c.paper and c.entry.source == source)
        lines.append(f"published numbers of {', '.join(rows)}: {source}")
    return _unique([*lines, *problems_of(table)])


def _majority(runs: pd.DataFrame) -> str:
    """Such as "32.0 %"; with that of each tier, where there are tiers."""

    def rates(score: str) -> str:
        return " or ".join(sorted({f"{100 * value:.1f} %" for value in runs[score].dropna()}))

    tiers = [f"{tier} {rate}" for tier in TIERS if (rate := rates(f"majority_rate_{tier}"))]
    return ", ".join([rates("majority_rate") or "not known", *tiers])


def problems_of(table: Table) -> list[str]:
    """What is wrong with cells' runs, or odd about them, each once."""
    return _unique(
        f"{cell.row}, {cell.column}: {said}"
        for cell in table.cells
        if cell.runs
        for said in (*cell.runs.problems, *cell.runs.notes)
    )


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


def markdown(table: Table) -> str:
    """Title, table, remarks, and the commands of what is not run."""
    rows = [[cell.replace("*", r"\*") for cell in line] for line in grid(table)]
    lines = [f"## {table.title}", "", *text_table.markdown(rows)]
    lines += ["", *(f"- {remark}" for remark in remarks(table))]
    if commands := to_run(table):
        lines += ["", f"{TO_RUN}:", "", "```", *commands, "```"]
    return "\n".join(lines) + "\n"


def latex(table: Table) -> str:
    """A booktabs tabular; remarks as comments, and what must be seen as lines below the rule."""
    header, *body = grid(table)
    notes = [table.title, r"\usepackage{booktabs}", *remarks(table)]
    lines = [f"% {' '.join(note.split())}" for note in notes]
    lines += [rf"\begin{{tabular}}{{@{{}}l{'c' * (len(header) - 1)}@{{}}}}", r"\toprule"]
    rows = map(text_table.latex_row, body)
    lines += [text_table.latex_row(header), r"\midrule", *rows, r"\bottomrule"]
    for mark in marks(table):
        text = text_table.latex_text(mark.removesuffix(": see below"))
        lines.append(rf"\multicolumn{{{len(header)}}}{{@{{}}l@{{}}}}{{\footnotesize {text}}} \\")
    return "\n".join([*lines, r"\end{tabular}"]) + "\n"


def csv_text(table: Table) -> str:
    """A line a cell and metric, in percent, with the command and what is wrong."""
    lines = [_csv_line(cell, metric) for cell in table.cells for metric in table.metrics]
    return pd.DataFrame(lines).to_csv(index=False, lineterminator="\n")


def _csv_line(cell: Cell, metric: Metric) -> dict[str, Any]:
    runs = cell.runs or Runs(pd.DataFrame(columns=["problem", "seed", *COSTS]))
    first, stat = runs.first, cell.ours(metric)

    def joined(name: str) -> str:
        return " ".join(f"{v:g}" for v in runs.finished[name].dropna()) if first is not None else ""

    def known(name: str) -> Any:
        return None if first is None else first[name]

    return {
        "row": cell.row,
        "column": cell.column,
        "metric": METRICS[metric].removesuffix(" %"),
        "mean": 100 * stat.mean if stat else None,
        "sem": 100 * stat.sem if stat and stat.sem is not None else None,
        "n": stat.n if stat else 0,
        "seeds": " ".join(map(str, runs.seeds)),
        "paper": cell.paper if metric == _ACCURACY else None,
        "paper_selected": cell.entry.selected,
        "paper_source": cell.entry.source,
        "task": None if first is None else task(first),
        "target": cell.target,
        "simulated": str(cell.simulated).lower() if cell.target else None,
        **{f"{role}_made_of": known(f"{role}_made_of") for role in ("source", "target")},
        **{f"{role}_selected": known(f"{role}_selected") for role in ("teacher", "student")},
        **{name: joined(name) for name in COSTS},
        "problems": "; ".join((*runs.problems, *runs.notes)) if cell.runs else "",
        "hash": known("hash"),
        "command": cell.command,
    }
