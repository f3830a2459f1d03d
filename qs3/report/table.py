"""The paper's tables and the field's benchmarks, with our numbers next to theirs.

Composing the command of a cell gives the config hash by which the runs of its seeds are found under
the log folder; runs of a kept file are found by row, column and seed. `formats` prints.
"""

import functools
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig

from qs3.config.compose import composed, override
from qs3.config.hydra import config_hash
from qs3.config.location import typed
from qs3.errors import ConfigError, Qs3Error
from qs3.report.results import (
    NO_RUNS,
    Runs,
    Stat,
    answers_of,
    load_runs,
    read_kept,
)
from qs3.report.spec import Entry, Spec, by_column, chosen, read_spec

INCOMPLETE = "†"
"""Marks a number that lacks a seed which failed or is not finished."""


@dataclass(frozen=True, eq=False)
class Cell:
    """One number of a table.

    `overrides` are those of train.py without the seed, empty if there is only a published number;
    `seeds` those that it should have; `runs` ours, finished or not; `target` is "" if not known.
    """

    row: str
    column: str
    entry: Entry
    overrides: tuple[str, ...]
    seeds: tuple[int, ...]
    runs: Runs = field(default_factory=lambda: Runs(NO_RUNS))
    target: str = ""
    simulated: bool = False

    @property
    def command(self) -> str:
        """The command that fills the cell; "" if there is none."""
        words = f"{shlex.join(self.overrides)} seed={','.join(map(str, self.seeds))} -m"
        return typed(f"python train.py {words}") if self.overrides else ""

    def text(self, metric: str) -> str:
        """What the table shows: the number, or why there is none."""
        done, mark = self.runs.finished, f" {INCOMPLETE}" * bool(self.runs.problems)
        if stat := self.runs.stat(metric):
            return stat.percent() + mark
        if done.empty:
            return f"not finished{mark}" if mark else "not run" * bool(self.overrides)
        if not done.labelled.any():
            return "no target labels"
        return "-" if done[metric].isna().all() else f"not averaged{mark}"


@dataclass(frozen=True, eq=False)
class Table:
    """A filled table: cells by row name, in the order of `columns`.

    `file_name` has the target and the columns that were asked for.
    """

    name: str
    file_name: str
    log_dir: str
    title: str
    notes: tuple[str, ...]
    spec: Spec
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[Cell, ...]]

    @property
    def cells(self) -> list[Cell]:
        """All cells."""
        return [cell for row in self.rows.values() for cell in row]

    @property
    def lines(self) -> pd.DataFrame:
        """All finished runs, a line a cell and seed, with the cell's row, column and command."""
        found = [
            cell.runs.finished.assign(
                row=cell.row, column=cell.column, command=shlex.join(cell.overrides)
            )
            for cell in self.cells
            if cell.runs.seeds
        ]
        return pd.concat(found or [NO_RUNS.assign(column="")], ignore_index=True)

    def average(self, row: str, metric: str) -> str:
        """Average of our numbers over all columns, by seed; "" unless all have the same seeds."""
        cells = self.rows[row]
        if not all(cell.runs.stat(metric) for cell in cells):
            return ""
        by_seed = pd.concat([cell.runs.finished for cell in cells]).groupby("seed")[metric]
        if not (by_seed.size() == len(cells)).all():
            return ""
        mark = f" {INCOMPLETE}" * any(cell.runs.problems for cell in cells)
        return Stat.of(by_seed.mean()).percent() + mark


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
    """
    name, spec = read_spec(name, rows)
    wanted = chosen(spec.columns, columns)
    shown = [c for c, task in spec.columns.items() if c in wanted or task is None]
    more = [*extra, *([f"domain@data.target={target}"] if target else [])]
    more += [] if str(log_dir) == "logs" else [override("paths.log_dir", log_dir)]
    own = by_column(more, tuple(spec.columns))
    found = load_runs(log_dir) if runs else {}
    known = read_kept(kept, target) if kept and runs else {}

    def cell(row: str, column: str, seeds: int, entry: Entry) -> Cell:
        if target:
            entry = replace(entry, paper=None)
        words = () if entry.run is None else (*shlex.split(entry.run), *own[column])
        task = spec.columns[column]
        few = min(seeds, task.seeds if task else seeds)
        made = Cell(row, _renamed(column, target), entry, words, tuple(range(few)))
        lines = known.get((row, made.column))
        if words and runs and (lines is not None or found or not known):
            return _filled(made, found, lines, target)
        return made

    parts = [re.sub(r"[^\w.]+", "-", one).strip("-.") for one in (name, target or "", *columns)]
    return Table(
        name,
        "-".join(filter(None, parts)),
        str(log_dir),
        f"{spec.title}, on another target: {target}" if target else spec.title,
        (*spec.notes, *([f"all cells on {target}, not the paper's target"] if target else [])),
        spec,
        tuple(_renamed(column, target) for column in shown),
        {
            row.name: tuple(cell(row.name, c, row.seeds, row.cells.get(c, Entry())) for c in shown)
            for row in spec.rows
        },
    )


def _renamed(column: str, target: str | None) -> str:
    """A column's name with another target: "S → D, DGCNN" becomes "S → kinectsim10, DGCNN"."""
    return re.sub(r"(?<= → )[^\s,;:(]+", lambda _: str(target), column) if target else column


def _filled(
    cell: Cell,
    found: Mapping[tuple[str, str, str], pd.DataFrame],
    kept: pd.DataFrame | None,
    target: str | None,
) -> Cell:
    """The cell with its runs: those of its config, and kept ones of the seeds that these lack."""
    lines = NO_RUNS
    if kept is None or found:
        key, cfg = composed_of(cell)
        if target and str(cfg.method.get("_target_")).endswith(".Supervised"):
            more = f"domain@data.source={target}"  # the upper bound has labels of its target
            cell = replace(cell, overrides=(*cell.overrides, more))
            key, cfg = composed_of(cell)
        domain = cfg.data.target
        cell = replace(cell, target=str(domain.name), simulated=bool(domain.simulated))
        lines = found.get((*key, cell.entry.take), NO_RUNS)
    if kept is not None:
        added = kept[~kept.seed.isin(lines.seed[lines.problem == ""])]
        lines = lines[(lines.problem == "") | ~lines.seed.isin(added.seed)]
        lines = pd.concat([part for part in (lines, added) if len(part)], ignore_index=True)
        first = kept.iloc[0]
        cell = replace(cell, target=first.target, simulated=bool(first.simulated))
    return replace(cell, runs=Runs(lines))


def composed_of(cell: Cell) -> tuple[tuple[str, str], DictConfig]:
    """Experiment and hash of a cell's command, and its config."""
    # Without the place of runs, which is not hashed: all folders share what is cached.
    words = tuple(word for word in cell.overrides if not word.startswith("paths.log_dir="))
    return _composed(words, f"table cell {cell.row!r}, {cell.column!r}: ")


@functools.lru_cache(maxsize=4096)
def _composed(words: tuple[str, ...], place: str) -> tuple[tuple[str, str], DictConfig]:
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
        except Qs3Error:  # a run without predictions
            found.append({})
    answers = pd.DataFrame(found)
    known = lines.drop(columns=["folder", "problem", *answers.columns], errors="ignore")
    first = ["row", "column", "seed"]
    return pd.concat([known[first], known.drop(columns=first), answers.fillna("")], axis=1)
