"""A table and its cells: plain values that `table` fills and `formats` prints."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from qs3.config.location import typed
from qs3.errors import ConfigError
from qs3.report.tables.aggregate import FEW_SEEDS, Group, Stat, value_of

SEEDS = (0, 1, 2)
Metric = Literal[
    "accuracy", "balanced_accuracy",
    "accuracy_clean", "accuracy_hard", "balanced_accuracy_clean", "balanced_accuracy_hard",
]  # fmt: skip
"""What a table can show: scores of all clouds, or of one tier of a dataset that has tiers."""

METRICS: Mapping[Metric, str] = {
    "accuracy": "accuracy %",
    "balanced_accuracy": "balanced accuracy %",
    "accuracy_clean": "accuracy, clean %",
    "accuracy_hard": "accuracy, hard %",
    "balanced_accuracy_clean": "balanced accuracy, clean %",
    "balanced_accuracy_hard": "balanced accuracy, hard %",
}
INCOMPLETE = "†"
"""Marks a number that lacks a seed which failed or is not finished."""


@dataclass(frozen=True)
class Published:
    """A number from a paper.

    Attributes:
        mean: in percent.
        sem: its standard error in percent; None if the paper gives none.
        selected: how the epoch that it belongs to was chosen; "" if the table does not say.
        source: where it was read; "" if that is the paper which the table's title names.
    """

    mean: float
    sem: float | None = None
    selected: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        if not 0 <= self.mean <= 100 or (self.sem is not None and not 0 <= self.sem <= 100):
            raise ConfigError(f"paper: {self.mean}, {self.sem}: percentages are from 0 to 100")

    def text(self) -> str:
        """Such as "72.4 ± 0.8"."""
        return f"{self.mean:.1f}" + ("" if self.sem is None else f" ± {self.sem:.1f}")


@dataclass(frozen=True)
class Cell:
    """One number of a table.

    Attributes:
        row, column: its place.
        overrides: of train.py, without the seed; empty if there is no experiment of ours, only
            a published number.
        paper: as published, or None.
        take: "final", or "warmup": the run's teacher before self-training. It equals the
            final result of the same run with selftraining=none, which need not be trained.
        group: our runs; None if there are none yet.
        missing: why the cell cannot be run at all ("" if it can).
        target: name of the target domain; "" if the cell is not to be run.
        simulated: whether that target is simulated.
        seeds: that it should have.
        first: its runs are started before those of other cells.
    """

    row: str
    column: str
    overrides: tuple[str, ...]
    paper: Published | None
    take: str = "final"
    group: Group | None = None
    missing: str = ""
    target: str = ""
    simulated: bool = False
    seeds: tuple[int, ...] = SEEDS
    first: bool = False

    @property
    def runnable(self) -> bool:
        """Whether there is an experiment of ours for it."""
        return bool(self.overrides)

    @property
    def command(self) -> str:
        """The command that fills the cell; "" if there is none."""
        if not self.runnable:
            return ""
        seeds = ",".join(map(str, self.seeds))
        return typed(f"python train.py {shlex.join(self.overrides)} seed={seeds} -m")

    @property
    def incomplete(self) -> bool:
        """Whether a seed failed, is not finished or not readable."""
        return bool(self.group and self.group.problems)

    def ours(self, metric: Metric) -> Stat | None:
        """Our mean of a metric; None if there is none."""
        return self.group.stat(metric, self.take) if self.group else None

    def text(self, metric: Metric) -> str:
        """What the table shows: the number, or why there is none."""
        mark = f" {INCOMPLETE}" if self.incomplete else ""
        if (stat := self.ours(metric)) is not None:
            return _with_n(stat) + mark
        if not self.runnable:
            return ""
        if self.missing:
            return "not available yet"
        if self.group and self.group.unlabelled:
            return "no target labels"
        results = self.group.results if self.group else []
        unknown = [value_of(result, metric, self.take) is None for result in results]
        if results and all(unknown):
            tiers = any(value_of(result, metric) is not None for result in results)
            return "not of warm-ups" if tiers else "no such tier"
        if any(unknown):
            return "not of every seed" + mark
        if self.group and self.group.finished:
            return "not averaged" + mark
        return "not finished" + mark if mark else "not run"


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
        benchmark: published numbers on lines of their own, with how they were selected, and an
            average over the columns.
        averages: published averages by row, in percent, where they differ in the last digit from
            the mean of the published numbers.
        costs: whether time and memory stand beside the numbers.
        factors: level of each factor, by row, of rows that cross several, such as two selectors by
            two schemes.
    """

    name: str
    title: str
    notes: tuple[str, ...]
    metrics: tuple[Metric, ...]
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[Cell | None, ...]]
    benchmark: bool = False
    averages: Mapping[str, float] = field(default_factory=dict)
    costs: bool = False
    factors: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @property
    def cells(self) -> list[Cell]:
        """All cells."""
        return [cell for row in self.rows.values() for cell in row if cell]

    def groups(self, row: str) -> list[Group]:
        """Finished runs of a row, by column."""
        cells = [cell for cell in self.rows[row] if cell]
        return [cell.group for cell in cells if cell.group and cell.group.finished]

    def ours(self, column: int) -> bool:
        """Whether a column is for runs of ours; else it has published numbers alone."""
        return any((cell := row[column]) and cell.runnable for row in self.rows.values())

    def simulated(self, column: int) -> tuple[str, ...]:
        """Names of a column's simulated targets."""
        cells = (row[column] for row in self.rows.values())
        return tuple(dict.fromkeys(c.target for c in cells if c and c.simulated))

    def average(self, row: str, metric: Metric) -> Stat | None:
        """Average of our numbers over all columns, by seed; None unless all have the same seeds."""
        values: dict[int, list[float]] = {}
        for cell in self.rows[row]:
            stat = cell.ours(metric) if cell else None
            if cell is None or cell.group is None or stat is None:
                return None
            for result in cell.group.results:
                found = value_of(result, metric, cell.take)
                if found is not None:
                    values.setdefault(result.seed, []).append(found)
        if any(len(v) != len(self.columns) for v in values.values()):
            return None
        return Stat.of([sum(v) / len(v) for v in values.values()])

    def average_text(self, row: str, metric: Metric) -> str:
        """What the table shows of it; "" if there is none."""
        stat = self.average(row, metric)
        if stat is None:
            return ""
        incomplete = any(cell.incomplete for cell in self.rows[row] if cell)
        return _with_n(stat) + f" {INCOMPLETE}" * incomplete

    def published_average(self, row: str) -> Published | None:
        """As published, or the mean of the published numbers if every column has one."""
        papers = [cell.paper for cell in self.rows[row] if cell and cell.paper]
        if len(papers) < len(self.columns):
            return None
        mean = self.averages.get(row, sum(paper.mean for paper in papers) / len(papers))
        return Published(mean, None, papers[0].selected, papers[0].source)


def _with_n(stat: Stat) -> str:
    """The number; of few seeds with how many they are."""
    return stat.percent() + (f" (n={stat.n})" if stat.n < FEW_SEEDS else "")
