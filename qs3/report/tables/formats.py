"""A table as Markdown, LaTeX (booktabs) and CSV. What all of them say comes from the same lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from qs3.datasets.importers.object_archive import TIERS
from qs3.report.tables.aggregate import FEW_SEEDS, Group, data_lines, task
from qs3.report.tables.cells import INCOMPLETE, METRICS, Cell, Metric, Table
from qs3.report.tables.made_of import OTHER_DATA, data_marks, is_other, results_of
from qs3.utils import text_table
from qs3.utils.plural import counted
from qs3.utils.text_table import latex_row, latex_text

_ACCURACY: Metric = "accuracy"  # what papers give, and each run on labels has
SIMULATED = "SIMULATED target"
TO_RUN = "Not run yet, or with fewer seeds than are wanted"
_RULES = {"source_val": "source validation", "last": "last epoch"}


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
        beside = "paper" if _ACCURACY in table.metrics else f"paper, {METRICS[_ACCURACY]}"
        header += _heads(table, i, many) + ([beside] if _has_paper(table, i) else [])
    header += ["core time a run", "memory"] if table.costs else []
    lines = [header if many else [*header, "seeds"]]
    for name, cells in table.rows.items():
        line = [name]
        for i, cell in enumerate(cells):
            paper = cell.paper if cell else None
            if not table.ours(i):
                line.append(f"{paper.text()} ({paper.selected})" if paper else "")
                continue
            line += _ours(table, cell)
            if _has_paper(table, i):
                line.append(paper.text() if paper else "")
        if table.costs:
            groups = table.groups(name)
            line += [_span(_core_seconds(groups)), _memory(groups)]
        if not many:
            finished = cells[0].group.seeds if cells[0] and cells[0].group else []
            line.append(", ".join(map(str, finished)) or "-")
        lines.append(line)
    return lines


def _heads(table: Table, column: int, named: bool) -> list[str]:
    mark = " (simulated)" if table.simulated(column) else ""
    name = f"{table.columns[column]}{mark}, " if named else ""
    return [f"{name}{METRICS[m]}{'' if named else mark}" for m in table.metrics]


def _benchmark_grid(table: Table) -> list[list[str]]:
    """Published numbers and ours on a line each, with the rule by which the epoch was chosen."""
    header = ["method", "by"]
    for i in range(len(table.columns)):
        named = len(table.metrics) > 1
        mark = " (simulated)" if table.simulated(i) else ""
        header += _heads(table, i, True) if named else [table.columns[i] + mark]
    header += [f"average {METRICS[m]}" for m in table.metrics]
    lines = [[*header, "epoch selected by"]]
    for name, cells in table.rows.items():
        papers = [cell.paper if cell else None for cell in cells]
        if any(papers) and _ACCURACY in table.metrics:
            line = [name, "published"]
            for paper in [*papers, table.published_average(name)]:
                line += [paper.text() if paper and m == _ACCURACY else "" for m in table.metrics]
            lines.append([*line, " or ".join(dict.fromkeys(p.selected for p in papers if p))])
        if any(cell and cell.runnable for cell in cells):
            line = [name, "ours"]
            for cell in cells:
                line += _ours(table, cell)
            other = any(is_other(table, cell) for cell in cells)
            line += [_marked(table.average_text(name, metric), other) for metric in table.metrics]
            rules = dict.fromkeys(_rule(c, "student") for c in cells if c and c.group)
            lines.append([*line, " or ".join(_RULES.get(rule, rule) for rule in rules if rule)])
    return lines


def _ours(table: Table, cell: Cell | None) -> list[str]:
    """Our figures of a cell, by metric."""
    other = is_other(table, cell)
    return [_marked(cell.text(m) if cell else "", other) for m in table.metrics]


def _marked(text: str, other: bool) -> str:
    return f"{text} {OTHER_DATA}" if other and text else text


def _has_paper(table: Table, column: int) -> bool:
    return any((cell := row[column]) and cell.paper for row in table.rows.values())


def _rule(cell: Cell, role: str) -> str:
    """How the epochs of a cell's runs were chosen: "source_val", without the epoch."""
    results = cell.group.results if cell.group else ()
    role = "teacher" if cell.take == "warmup" else role
    rules = {getattr(result.selection, role).split(", epoch")[0] for result in results}
    return " or ".join(sorted(rules))


def details(table: Table) -> list[list[str]]:
    """What stands behind each of our numbers, a line a cell, header first."""
    header = ["method", "task", "target", "mean ± SEM %", "n", "seeds", "teacher selected by",
              "student selected by", "time a run", "core time", "memory", "runs"]  # fmt: skip
    lines = [header]
    for cell in table.cells:
        if cell.group is None or not cell.group.finished:
            continue
        stat = cell.ours(table.metrics[0])
        lines.append(
            [
                cell.row,
                cell.column,
                cell.target + " (simulated)" * cell.simulated,
                stat.percent() if stat else cell.text(table.metrics[0]),
                str(stat.n if stat else 0),
                ", ".join(map(str, cell.group.seeds)),
                _rule(cell, "teacher"),
                _rule(cell, "student"),
                _span(seconds(cell.group)),
                _span(_core_seconds([cell.group])),
                _memory([cell.group]),
                f"{cell.group.experiment}/seed*-{cell.group.hash}",
            ]
        )
    return lines


def seconds(group: Group) -> list[float]:
    """Wall time of each finished run over all of its starts."""
    return [result.times.seconds for result in group.results]


def _core_seconds(groups: Sequence[Group]) -> list[float]:
    """Processor time of the finished runs of which it is known."""
    times = [result.times for group in groups for result in group.results]
    return [t.core_seconds for t in times if t.core_seconds is not None]


def _span(found: Sequence[float]) -> str:
    """Seconds such as "3.5 min" or "3.5 to 4.1 min"; "" of none."""
    most = max(found, default=0.0)
    unit, name = next(
        (u, n) for u, n in ((3600, "h"), (60, "min"), (1, "s")) if most >= u or u == 1
    )
    return _from_to([value / unit for value in found], name)


def _memory(groups: Sequence[Group]) -> str:
    """Such as "0.8 GB" or "0.8 to 0.9 GB, GPU 2.1 GB"; "" where it is not known."""
    times = [result.times for group in groups for result in group.results]
    parts = [
        _from_to([t.memory_gb for t in times if t.memory_gb is not None], "GB"),
        _from_to([t.gpu_memory_gb for t in times if t.gpu_memory_gb is not None], "GB"),
    ]
    return parts[0] + (f", GPU {parts[1]}" if parts[1] else "")


def _from_to(values: Sequence[float], unit: str) -> str:
    if not values:
        return ""
    ends = dict.fromkeys(f"{value:.1f}" for value in (min(values), max(values)))
    return f"{' to '.join(ends)} {unit}"


def marks(table: Table) -> list[str]:
    """What must not be overlooked; stands in the table itself where a format has no other text."""
    lines = []
    found = [name for i in range(len(table.columns)) for name in table.simulated(i)]
    if found:
        lines.append(f"{SIMULATED}: {', '.join(dict.fromkeys(found))}")
    lines += data_marks(table)
    if any(cell.incomplete for cell in table.cells):
        lines.append(f"{INCOMPLETE} seeds that failed, are not finished or do not fit: see below")
    return lines


def remarks(table: Table) -> list[str]:
    """The lines below a table: what it is measured on, how models were chosen, what is missing."""
    found = [g for cell in table.cells if (g := cell.group) and g.finished]
    targets = {g.first.target: g.first.simulated for g in found if g.first}
    lines = [*marks(table), *table.notes]
    lines += data_lines(results_of(table))
    for target, simulated_ in targets.items():
        of = [g for g in found if g.first and g.first.target == target]
        simulated = "simulated target" if simulated_ else "target"
        lines.append(f"majority rate of the {simulated} {target}: {_majority(of)}")
    for role in ("teacher", "student"):
        rules = {rule for cell in table.cells if (rule := _rule(cell, role))}
        if rules:
            lines.append(f"{role} selected by: {', '.join(sorted(rules))}")
    splits = {result.selection.validation for g in found for result in g.results}
    if splits - {"lineage"}:
        lines.append(f"validation split: {', '.join(sorted(splits))}")
    if found:
        counts = sorted({len(g.finished) for g in found})
        few, most = counts[0], counts[-1]
        seeds = counted(few, "seed") if few == most else f"{few} to {most} seeds"
        lines.append(f"mean ± standard error over {seeds}; (n=...) marks fewer than {FEW_SEEDS}")
        if any(seconds(g) for g in found):
            lines.append(
                "time: wall time of each run, the least and the most; all of its starts together, "
                "also the warm-up that was taken from another run; core time: likewise the time of "
                "all cores that worked for it, which others on a busy machine change little; "
                "memory: the most that its process had"
            )
    for source in dict.fromkeys(c.paper.source for c in table.cells if c.paper and c.paper.source):
        rows = dict.fromkeys(c.row for c in table.cells if c.paper and c.paper.source == source)
        lines.append(f"published numbers of {', '.join(rows)}: {source}")
    lines += problems_of(table)
    missing = [c for c in table.cells if c.missing]
    for reason in dict.fromkeys(c.missing for c in missing):
        lines.append(f"not available yet: {reason}")
    return list(dict.fromkeys(lines))


def problems_of(table: Table) -> list[str]:
    """What is wrong with cells' runs, or odd about them, each once."""
    lines = [
        f"{cell.row}, {cell.column}: {said}"
        for cell in table.cells
        if cell.group
        for said in (*cell.group.problems, *cell.group.notes)
    ]
    return list(dict.fromkeys(lines))


def _majority(groups: Sequence[Group]) -> str:
    """Such as "32.0 %"; with that of each tier, where there are tiers."""

    def rates(score: str) -> str:
        stats = [g.stat(score) for g in groups]
        return " or ".join(sorted({f"{100 * stat.mean:.1f} %" for stat in stats if stat}))

    tiers = [f"{tier} {rate}" for tier in TIERS if (rate := rates(f"majority_rate_{tier}"))]
    return ", ".join([rates("majority_rate") or "unknown", *tiers])


def to_run(table: Table) -> list[str]:
    """Commands that fill the cells without a number or with few seeds, each once.

    By the accuracy, which every run on labels has: no command brings a tier that a target lacks.
    """
    empty = [
        cell
        for cell in table.cells
        if cell.runnable
        and not cell.missing
        and ((stat := cell.ours(_ACCURACY)) is None or stat.n < len(cell.seeds))
        and not (cell.group and cell.group.unlabelled)
    ]
    return list(dict.fromkeys(cell.command for cell in empty))


def markdown(table: Table) -> str:
    """Title, table, remarks, what stands behind each number, the commands of what is not run."""
    lines = [f"## {table.title}", "", *_markdown_table(grid(table))]
    lines += ["", *(f"- {remark}" for remark in remarks(table))]
    if len(behind := details(table)) > 1:
        lines += ["", "Behind each number:", "", *_markdown_table(behind)]
    if commands := to_run(table):
        lines += ["", f"{TO_RUN}:", "", "```", *commands, "```"]
    return "\n".join(lines) + "\n"


def _markdown_table(lines: Sequence[Sequence[str]]) -> list[str]:
    return text_table.markdown([[cell.replace("*", r"\*") for cell in line] for line in lines])


def latex(table: Table) -> str:
    """A booktabs tabular; remarks as comments, and what must be seen as lines below the rule."""
    header, *body = grid(table)
    behind = details(table)
    notes = remarks(table) + (["; ".join(line) for line in behind] if len(behind) > 1 else [])
    package = r"\usepackage{booktabs}"
    lines = [f"% {' '.join(note.split())}" for note in [table.title, package, *notes]]
    lines += [rf"\begin{{tabular}}{{@{{}}l{'c' * (len(header) - 1)}@{{}}}}", r"\toprule"]
    lines += [latex_row(header), r"\midrule", *map(latex_row, body), r"\bottomrule"]
    for mark in marks(table):
        text = latex_text(mark.removesuffix(": see below"))
        lines.append(rf"\multicolumn{{{len(header)}}}{{@{{}}l@{{}}}}{{\footnotesize {text}}} \\")
    return "\n".join([*lines, r"\end{tabular}"]) + "\n"


def csv_text(table: Table) -> str:
    """A line a cell and metric, in percent, with the command and what is wrong."""
    rows: list[list[Any]] = [
        ["row", "column", "metric", "mean", "sem", "n", "seeds", "paper_mean", "paper_sem",
         "paper_selected", "paper_source", "task", "target", "simulated", "source_made_of",
         "target_made_of", "teacher_selected", "student_selected", "seconds", "core_seconds",
         "memory_gb", "gpu_memory_gb", "problems", "hash", "command"]
    ]  # fmt: skip
    for cell in table.cells:
        known = cell.group.first if cell.group else None
        times = seconds(cell.group) if cell.group else []
        for metric in table.metrics:
            stat, paper = cell.ours(metric), cell.paper if metric == _ACCURACY else None
            values: list[Any] = [cell.row, cell.column, METRICS[metric].removesuffix(" %")]
            values += [100 * stat.mean, _percent(stat.sem), stat.n] if stat else ["", "", 0]
            values.append(" ".join(map(str, cell.group.seeds)) if cell.group else "")
            values += [paper.mean, "" if paper.sem is None else paper.sem] if paper else ["", ""]
            values += [paper.selected, paper.source] if paper else ["", ""]
            values += [task(known) if known else "", cell.target]
            values.append(str(cell.simulated).lower() if cell.target else "")
            values += [known.made_of.source, known.made_of.target] if known else ["", ""]
            values += [_rule(cell, "teacher"), _rule(cell, "student")]
            values.append(" ".join(f"{value:g}" for value in times))
            taken = [result.times for result in cell.group.results] if cell.group else []
            for name in ("core_seconds", "memory_gb", "gpu_memory_gb"):
                found = [getattr(one, name) for one in taken]
                values.append(" ".join("" if one is None else f"{one:g}" for one in found))
            values.append(
                "; ".join((*cell.group.problems, *cell.group.notes)) if cell.group else ""
            )
            rows.append([*values, cell.group.hash if cell.group else "", cell.command])
    return text_table.csv_text(rows)


def _percent(value: float | None) -> float | str:
    return "" if value is None else 100 * value
