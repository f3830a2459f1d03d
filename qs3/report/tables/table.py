"""The paper's tables and the field's benchmarks, with our numbers next to theirs.

Composing the command of a cell gives the config hash by which the runs of its seeds are found under
the log folder; runs of a kept file are found by row, column and seed. `formats` prints.
"""

from __future__ import annotations

import functools
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import pandas as pd
from omegaconf import DictConfig

from qs3.config.compose import choices, composed, override
from qs3.config.location import typed
from qs3.errors import ConfigError, DataError
from qs3.report.tables.results import (
    FEW_SEEDS,
    Runs,
    Stat,
    answers_of,
    complete,
    frame,
    load_runs,
    read_kept,
)
from qs3.report.tables.spec import Entry, Metric, by_column, chosen, read_spec

METRICS: Mapping[Metric, str] = {
    name: re.sub("_(clean|hard)", r", \1", name).replace("_", " ") + " %"
    for name in get_args(Metric)
}
INCOMPLETE = "†"
"""Marks a number that lacks a seed which failed or is not finished."""
OTHER_DATA = "‡"
"""Marks a number of ours that stands next to published ones and was not measured on their data."""


@dataclass(frozen=True, eq=False)
class Cell:
    """One number of a table.

    Attributes:
        row, column: its place.
        entry: of the table's file.
        overrides: of train.py, without the seed; empty if there is only a published number.
        seeds: that it should have.
        runs: ours, finished or not; None if there are none yet.
        target: name of the target domain; "" if it is not known.
        simulated: whether that target is simulated.
    """

    row: str
    column: str
    entry: Entry
    overrides: tuple[str, ...]
    seeds: tuple[int, ...]
    runs: Runs | None = None
    target: str = ""
    simulated: bool = False

    @property
    def paper(self) -> str:
        """The published number."""
        return self.entry.published

    @property
    def runnable(self) -> bool:
        """Whether there is an experiment of ours for it."""
        return bool(self.overrides)

    @property
    def command(self) -> str:
        """The command that fills the cell; "" if there is none."""
        words = f"{shlex.join(self.overrides)} seed={','.join(map(str, self.seeds))} -m"
        return typed(f"python train.py {words}") if self.runnable else ""

    @property
    def incomplete(self) -> bool:
        """Whether a seed failed, is not finished or does not fit."""
        return bool(self.runs and self.runs.problems)

    @property
    def finished(self) -> bool:
        """Whether a run of ours is finished."""
        return bool(self.runs and self.runs.seeds)

    def ours(self, metric: str) -> Stat | None:
        """Our mean of a metric; None if there is none."""
        return self.runs.stat(metric) if self.runs else None

    def text(self, metric: Metric) -> str:
        """What the table shows: the number, or why there is none."""
        mark = f" {INCOMPLETE}" if self.incomplete else ""
        if (stat := self.ours(metric)) is not None:
            return _with_n(stat) + mark
        if self.runs is None or not self.finished:
            return f"not finished{mark}" if mark else "not run" if self.runnable else ""
        if not self.runs.finished.labelled.any():
            return "no target labels"
        return "-" if self.runs.finished[metric].isna().all() else f"not averaged{mark}"


@dataclass(frozen=True, eq=False)
class Table:
    """A filled table.

    Attributes:
        name: of its file.
        file_name: of its own files: with the target and the columns that were asked for.
        log_dir: of its runs.
        title, notes: for above and below it.
        metrics: keys of METRICS.
        columns: names of the tasks.
        rows: cells by row name, in the order of `columns`.
        benchmark: see `Spec.layout`.
        averages: published averages by row, in percent, where they differ in the last digit from
            the mean of the published numbers.
        factors: level of each factor, by row, of rows that cross several.
    """

    name: str
    file_name: str
    log_dir: str
    title: str
    notes: tuple[str, ...]
    metrics: tuple[Metric, ...]
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[Cell | None, ...]]
    benchmark: bool = False
    averages: Mapping[str, float] = field(default_factory=dict)
    factors: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @property
    def cells(self) -> list[Cell]:
        """All cells."""
        return [cell for row in self.rows.values() for cell in row if cell]

    @property
    def lines(self) -> pd.DataFrame:
        """All finished runs, a line a cell and seed, with the cell's row, column and command."""
        found = [
            cell.runs.finished.assign(
                row=cell.row, column=cell.column, command=shlex.join(cell.overrides)
            )
            for cell in self.cells
            if cell.runs and cell.finished
        ]
        return complete(pd.concat(found, ignore_index=True)) if found else pd.DataFrame()

    def ours(self, column: int) -> bool:
        """Whether a column is for runs of ours; else it has published numbers alone."""
        return any((cell := row[column]) and cell.runnable for row in self.rows.values())

    def simulated(self, column: int) -> list[str]:
        """Names of a column's simulated targets."""
        cells = (row[column] for row in self.rows.values())
        return list(dict.fromkeys(c.target for c in cells if c and c.simulated))

    def average_text(self, row: str, metric: Metric) -> str:
        """Average of our numbers over all columns, by seed; "" unless all have the same seeds."""
        cells = [cell for cell in self.rows[row] if cell and cell.ours(metric)]
        if len(cells) < len(self.columns):
            return ""
        values = pd.concat([c.runs.finished[["seed", metric]] for c in cells if c.runs])
        by_seed = values.groupby("seed")[metric]
        if not (by_seed.size() == len(self.columns)).all():
            return ""
        mark = f" {INCOMPLETE}" * any(cell.incomplete for cell in cells)
        return _with_n(Stat.of(by_seed.mean())) + mark

    def published_average(self, row: str) -> str:
        """As published, or the mean of the published numbers if every column has one."""
        means = [cell.entry.mean for cell in self.rows[row] if cell and cell.entry.mean is not None]
        if len(means) < len(self.columns):
            return ""
        return f"{self.averages.get(row, sum(means) / len(means)):.1f}"


def _with_n(stat: Stat) -> str:
    """The number; of few seeds with how many they are."""
    return stat.percent() + (f" (n={stat.n})" if stat.n < FEW_SEEDS else "")


def build_table(
    name: str,
    log_dir: str | Path = "logs",
    extra: Sequence[str] = (),
    target: str | None = None,
    kept: str | Path | None = None,
    rows: Sequence[Mapping[str, Any]] = (),
    columns: Sequence[str] = (),
    runs: bool = True,
) -> Table:
    """Read a table's file and find our runs of its cells.

    Args:
        name: of a file in conf/table, or the path of one's own, NAME.yaml.
        log_dir: `paths.log_dir` of the runs.
        extra: overrides of all runs, or of those of some columns (`spec.by_column`).
        target: another target domain for all cells; published numbers are then left out.
        kept: file of results of `qs3 report keep`; taken where `log_dir` lacks a seed.
        rows: further ones, as in the file.
        columns: only these (`spec.chosen`), and those that are published alone.
        runs: look for them.

    Raises:
        ConfigError: no such table, or its file, an override, a column or the target is wrong.
    """
    name, spec = read_spec(name, rows)
    if target and target not in choices("domain"):
        raise ConfigError(f"target={target} is not one of {', '.join(choices('domain'))}")
    if target and not spec.rows_have_targets:
        raise ConfigError(f"target={target}: the columns of table {name} have targets of their own")
    wanted = chosen(spec.columns, columns, f"table {name}, columns: ")
    shown = [c for c, task in spec.columns.items() if c in wanted or task is None]
    more = [*extra, *([f"domain@data.target={target}"] if target else [])]
    more += [] if str(log_dir) == "logs" else [override("paths.log_dir", log_dir)]
    own = by_column(more, tuple(spec.columns))
    found = load_runs(log_dir) if runs else {}
    known = read_kept(kept, target) if kept and runs else {}
    filled: dict[str, tuple[Cell | None, ...]] = {}
    for row in spec.rows:
        cells: list[Cell | None] = []
        for column in shown:
            entry, task = row.cells.get(column), spec.columns[column]
            if entry is None or (entry.run is None and target):
                cells.append(None)
                continue
            cell = Cell(
                row.name,
                _renamed(column, target),
                replace(entry, paper=None) if target else entry,
                () if entry.run is None else (*shlex.split(entry.run), *own[column]),
                tuple(range(min(row.seeds, task.seeds if task else row.seeds))),
            )
            lines = known.get((cell.row, cell.column))
            if cell.runnable and runs and (lines is not None or found or not known):
                cell = _filled(cell, found, lines, target)
            cells.append(cell)
        filled[row.name] = tuple(cells)
    averages = {row.name: row.average for row in spec.rows if row.average is not None}
    parts = [re.sub(r"[^\w.]+", "-", one).strip("-.") for one in (name, target or "", *columns)]
    return Table(
        name,
        "-".join(filter(None, parts)),
        str(log_dir),
        f"{spec.title}, on another target: {target}" if target else spec.title,
        (*spec.notes, *([f"all cells on {target}, not the paper's target"] if target else [])),
        tuple(spec.metrics),
        tuple(_renamed(column, target) for column in shown),
        filled,
        bool(spec.layout),
        averages if len(shown) == len(spec.columns) else {},
        {row.name: row.factors for row in spec.rows if row.factors},
    )


def _renamed(column: str, target: str | None) -> str:
    """A column's name with another target: "S → D, DGCNN" becomes "S → kinectsim10, DGCNN"."""
    return re.sub(r"(?<= → )[^\s,;:(]+", lambda _: str(target), column) if target else column


def _filled(
    cell: Cell,
    found: Mapping[tuple[str, str], list[dict[str, Any]]],
    kept: pd.DataFrame | None,
    target: str | None,
) -> Cell:
    """The cell with its runs: those of its config, and kept ones of the seeds that these lack."""
    lines = pd.DataFrame()
    if kept is None or found:
        place = f"table cell {cell.row!r}, {cell.column!r}: "
        # Without the place of runs, which is not hashed: all folders share what is cached.
        words = tuple(word for word in cell.overrides if not word.startswith("paths.log_dir="))
        key, cfg = _composed(words, place)
        if target and str(cfg.method.get("_target_")).endswith(".Supervised"):
            more = f"domain@data.source={target}"  # the upper bound has labels of its target
            cell = replace(cell, overrides=(*cell.overrides, more))
            key, cfg = _composed((*words, more), place)
        domain = cfg.data.target
        cell = replace(cell, target=str(domain.name), simulated=bool(domain.simulated))
        if runs := found.get(key):
            lines = frame(runs, cell.entry.take)
    if kept is not None:
        done = lines.seed[lines.problem == ""].tolist() if len(lines) else []
        added = kept[~kept.seed.isin(done)]
        if len(lines):
            lines = lines[(lines.problem == "") | ~lines.seed.isin(added.seed)]
        lines = complete(pd.concat([lines, added], ignore_index=True)) if len(lines) else added
        first = kept.iloc[0]
        cell = replace(cell, target=first.target, simulated=bool(first.simulated))
    return replace(cell, runs=Runs(lines)) if len(lines) else cell


@functools.lru_cache(maxsize=4096)
def _composed(words: tuple[str, ...], place: str) -> tuple[tuple[str, str], DictConfig]:
    """Experiment and hash of a command line of train.py, and its config."""
    from qs3.config.hashing import config_hash

    cfg = composed("train", *words, place=place)
    return (str(cfg.experiment_name), config_hash(cfg)), cfg


def kept_lines(table: Table) -> pd.DataFrame:
    """The lines of a table's finished runs as a kept file has them, with all answers."""
    lines = table.lines
    if lines.empty:
        raise ConfigError(f"table {table.name} has no finished runs")
    found = []
    for run in lines.to_dict("records"):
        try:
            found.append(answers_of(run).as_text if run["take"] == "final" else {})
        except DataError:  # a run without predictions
            found.append({})
    answers = pd.DataFrame(found)
    known = lines.drop(columns=["folder", "problem", *answers.columns], errors="ignore")
    first = ["row", "column", "seed"]
    return pd.concat([known[first], known.drop(columns=first), answers.fillna("")], axis=1)
