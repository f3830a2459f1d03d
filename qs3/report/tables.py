"""The paper's tables with our numbers beside them. A table is a file of conf/table/.

Each cell names a run by its command line; composing it gives the config hash by which the runs
of its seeds are found under the log folder.
"""

from __future__ import annotations

import contextlib
import csv
import io
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped,unused-ignore]

from qs3.errors import ConfigError
from qs3.report.aggregate import DIAGNOSTIC, FEW_SEEDS, Group, Stat, group, load_runs, task
from qs3.selftraining.student_rules import ORACLE, ORACLE_IN_WORDS

CONF = Path(__file__).parents[2] / "conf"
SEEDS = "0,1,2"
METRICS = {"accuracy": "accuracy %", "balanced_accuracy": "balanced accuracy %"}


@dataclass(frozen=True)
class Cell:
    """One number of a table.

    Attributes:
        row, column: its place.
        overrides: of train.py, without the seed.
        paper: mean and SEM in percent as published, or None.
        take: "final", or "warmup": the run's teacher before self-training. It equals the
            final result of the same run with selftraining=none, which need not be trained.
        group: our runs; None if there are none yet.
        missing: why the cell cannot be run at all ("" if it can).
    """

    row: str
    column: str
    overrides: tuple[str, ...]
    paper: tuple[float, float] | None
    take: str = "final"
    group: Group | None = None
    missing: str = ""

    @property
    def command(self) -> str:
        """The command that fills the cell."""
        return f"python train.py {shlex.join(self.overrides)} seed={SEEDS} -m"

    def ours(self, metric: str) -> Stat | None:
        """Our mean of a metric; None if there is none."""
        where = ("warmup", "selected") if self.take == "warmup" else ("final",)
        return self.group.stat(*where, metric) if self.group else None

    def text(self, metric: str) -> str:
        """What the table shows: the number, or why there is none."""
        if (stat := self.ours(metric)) is not None:
            few = f" (n={stat.n})" if stat.n < FEW_SEEDS else ""
            return stat.percent() + few
        if self.missing:
            return "not available yet"
        if self.group and self.group.unlabelled:
            return "no target labels"
        return "not averaged" if self.group and self.group.finished else "not run"


@dataclass(frozen=True)
class Table:
    """A filled table.

    Attributes:
        name: of its file.
        title: one line.
        notes: lines that belong below it.
        metrics: keys of METRICS.
        columns: names of the tasks.
        rows: cells by row name, in the order of `columns`.
    """

    name: str
    title: str
    notes: tuple[str, ...]
    metrics: tuple[str, ...]
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[Cell | None, ...]]

    @property
    def cells(self) -> list[Cell]:
        """All cells."""
        return [cell for row in self.rows.values() for cell in row if cell]


def table_names() -> list[str]:
    """The tables there are."""
    return sorted(path.stem for path in (CONF / "table").glob("*.yaml"))


def build_table(
    name: str,
    log_dir: str | Path = "logs",
    extra: Sequence[str] = (),
    target: str | None = None,
) -> Table:
    """Read a table's file and find our runs of its cells.

    Args:
        name: of a file in conf/table.
        log_dir: `paths.log_dir` of the runs.
        extra: overrides of train.py for every cell, as the runs had them.
        target: another target domain for all cells, e.g. "kinectsim10"; the paper's numbers,
            measured on another target, are then left out.

    Raises:
        ConfigError: no such table, or its file or an override is wrong.
    """
    if name not in table_names():
        raise ConfigError(f"there is no table {name!r}; there are {', '.join(table_names())}")
    path = CONF / "table" / f"{name}.yaml"
    try:
        spec = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: {error}") from error
    runs = load_runs(log_dir)
    groups = {(g.experiment, g.hash): g for g in group(runs)}
    more = [*extra, *([f"domain@data.target={target}"] if target else [])]
    if str(log_dir) != "logs":
        more.append(f"paths.log_dir={log_dir}")
    try:
        cells = [
            Cell(
                row["name"],
                column,
                (*shlex.split(row[column]["run"]), *more),
                None if target or "paper" not in row[column] else tuple(row[column]["paper"]),
                row[column].get("take", "final"),
            )
            for row in spec["rows"]
            for column in spec["columns"]
            if column in row
        ]
        filled = {(c.row, c.column): c for c in _fill(cells, groups)}
        metrics = tuple(spec["metrics"])
        rows = {
            row["name"]: tuple(filled.get((row["name"], column)) for column in spec["columns"])
            for row in spec["rows"]
        }
        title, notes, columns = spec["title"], spec.get("notes", []), tuple(spec["columns"])
    except (KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path}: missing or wrong entry {error}") from error
    if unknown := sorted(set(metrics) - set(METRICS)):
        raise ConfigError(f"{path}: unknown metrics {unknown}; known are {', '.join(METRICS)}")
    if target:
        notes = [*notes, f"all cells on the target {target}, which is not the paper's"]
    if left_out := sum(run.status == DIAGNOSTIC for run in runs):
        notes = [*notes, f"runs left out: {left_out}, chosen by the {ORACLE_IN_WORDS}"]
    return Table(name, title, tuple(notes), metrics, columns, rows)


def _fill(cells: Sequence[Cell], groups: Mapping[tuple[str, str], Group]) -> list[Cell]:
    """The cells with their runs, or with the reason why they cannot be run."""
    from hydra.errors import ConfigCompositionException, MissingConfigException

    from qs3.runs import config_hash

    filled = []
    with composing() as compose:
        for cell in cells:
            try:
                cfg = compose("train", list(cell.overrides))
            except MissingConfigException as error:
                filled.append(replace(cell, missing=_first_line(error)))
                continue
            except ConfigCompositionException as error:
                raise ConfigError(
                    f"table cell {cell.row!r}, {cell.column!r}: {_first_line(error)}"
                ) from error
            _refuse_oracle(cell, cfg)
            key = (str(cfg.experiment_name), config_hash(cfg))
            filled.append(replace(cell, group=groups.get(key)))
    return filled


def _refuse_oracle(cell: Cell, cfg: Any) -> None:
    if cfg.selection.student == ORACLE:
        raise ConfigError(
            f"table cell {cell.row!r}, {cell.column!r}: selection.student={ORACLE} chooses by the "
            "target's test labels. That is a diagnostic and enters no table; take it out of the "
            "cell's line, of its experiment, or of overrides="
        )


@contextlib.contextmanager
def composing() -> Iterator[Callable[[str, list[str]], Any]]:
    """Hydra's compose on the repository's conf/, also inside a running Hydra application."""
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    import qs3.hydra_glue  # noqa: F401  registers the resolvers that the configs use

    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            yield compose
    finally:
        GlobalHydra.instance().hydra = running


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


# ----------------------------------------------------------------------------- what is printed


def grid(table: Table) -> list[list[str]]:
    """The table as strings, header first: for each task our metrics, then the paper's if any."""
    many = len(table.columns) > 1
    header = ["method"]
    for i, column in enumerate(table.columns):
        header += [f"{column}, {METRICS[m]}" if many else METRICS[m] for m in table.metrics] + (
            ["paper"] if _has_paper(table, i) else []
        )
    lines = [header if many else [*header, "seeds"]]
    for name, cells in table.rows.items():
        line = [name]
        for i, cell in enumerate(cells):
            line += [cell.text(metric) if cell else "" for metric in table.metrics]
            if _has_paper(table, i):
                paper = cell.paper if cell else None
                line.append(f"{paper[0]:.1f} ± {paper[1]:.1f}" if paper else "")
        if not many:
            finished = cells[0].group.seeds if cells[0] and cells[0].group else []
            line.append(", ".join(map(str, finished)) or "-")
        lines.append(line)
    return lines


def _has_paper(table: Table, column: int) -> bool:
    return any((cell := row[column]) and cell.paper for row in table.rows.values())


def remarks(table: Table) -> list[str]:
    """The lines below a table: what it is measured on, how models were chosen, what is missing."""
    found = [g for cell in table.cells if (g := cell.group) and g.finished]
    lines = list(table.notes)
    for target in dict.fromkeys(str(g.first["target"]) for g in found):
        of = [g for g in found if str(g.first["target"]) == target]
        simulated = "simulated target" if of[0].first.get("simulated") else "target"
        rates = sorted(
            {f"{100 * s.mean:.1f} %" for g in of if (s := g.stat("final", "majority_rate"))}
        )
        lines.append(
            f"majority rate of the {simulated} {target}: {' or '.join(rates) or 'unknown'}"
        )
    for role in ("teacher", "student"):
        rules = {
            str(rule).split(", epoch")[0]
            for g in found
            for run in g.finished
            if (rule := run.metrics.get("selection", {}).get(role))
        }
        if rules:
            lines.append(f"{role} selected by: {', '.join(sorted(rules))}")
    splits = {
        str(run.metrics.get("selection", {}).get("validation", "lineage"))
        for g in found
        for run in g.finished
    }
    if splits - {"lineage"}:
        lines.append(f"validation split: {', '.join(sorted(splits))}")
    if found:
        counts = sorted({len(g.finished) for g in found})
        seeds = f"{' or '.join(map(str, counts))} seed{'s' * (counts[-1] > 1)}"
        lines.append(f"mean ± standard error over {seeds}; (n=...) marks fewer than {FEW_SEEDS}")
    for cell in table.cells:
        for problem in cell.group.problems if cell.group else ():
            lines.append(f"{cell.row}, {cell.column}: {problem}")
    missing = [c for c in table.cells if c.missing]
    for reason in dict.fromkeys(c.missing for c in missing):
        lines.append(f"not available yet: {reason}")
    return list(dict.fromkeys(lines))


def to_run(table: Table) -> list[str]:
    """Commands that fill the cells without a number, each once."""
    empty = [
        cell
        for cell in table.cells
        if not cell.missing
        and cell.ours(table.metrics[0]) is None
        and not (cell.group and cell.group.unlabelled)
    ]
    return list(dict.fromkeys(cell.command for cell in empty))


def markdown(table: Table) -> str:
    """Title, table, remarks, and the commands of what is not run."""
    header, *body = grid(table)
    widths = [max(len(row[i]) for row in [header, *body]) for i in range(len(header))]

    def row(cells: Sequence[str]) -> str:
        return "| " + " | ".join(c.ljust(w) for c, w in zip(cells, widths, strict=True)) + " |"

    lines = [f"## {table.title}", "", row(header)]
    lines.append("|" + "|".join("-" * (width + 2) for width in widths) + "|")
    lines += [row(cells) for cells in body]
    lines += ["", *(f"- {remark}" for remark in remarks(table))]
    if commands := to_run(table):
        lines += ["", "Not run yet:", "", "```", *commands, "```"]
    return "\n".join(lines) + "\n"


def latex(table: Table) -> str:
    """A booktabs tabular; remarks as comments."""
    header, *body = grid(table)
    lines = [f"% {remark}" for remark in remarks(table)]
    lines += [rf"\begin{{tabular}}{{@{{}}l{'c' * (len(header) - 1)}@{{}}}}", r"\toprule"]
    lines += [_latex_row(header), r"\midrule", *map(_latex_row, body), r"\bottomrule"]
    return "\n".join([*lines, r"\end{tabular}"]) + "\n"


def _latex_row(cells: Sequence[str]) -> str:
    text = " & ".join(cell.replace("%", r"\%").replace("_", r"\_") for cell in cells)
    return text.replace("±", r"$\pm$").replace("→", r"$\rightarrow$") + r" \\"


def csv_text(table: Table) -> str:
    """A line a cell and metric, in percent, with the command."""
    file = io.StringIO(newline="")
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(
        ["row", "column", "metric", "mean", "sem", "n", "seeds", "paper_mean", "paper_sem",
         "task", "hash", "command"]
    )  # fmt: skip
    for cell in table.cells:
        for metric in table.metrics:
            stat, paper = cell.ours(metric), cell.paper if metric == "accuracy" else None
            values: list[Any] = [cell.row, cell.column, METRICS[metric].removesuffix(" %")]
            values += [100 * stat.mean, _percent(stat.sem), stat.n] if stat else ["", "", 0]
            values.append(" ".join(map(str, cell.group.seeds)) if cell.group else "")
            values += list(paper or ("", ""))
            known = cell.group.first if cell.group else {}
            values += [task(known) if known else "", cell.group.hash if cell.group else ""]
            writer.writerow([*values, cell.command])
    return file.getvalue()


def _percent(value: float | None) -> float | str:
    return "" if value is None else 100 * value
