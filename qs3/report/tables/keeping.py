"""Results of a table's runs, kept in a small folder that can be committed or sent on.

A run's folder holds its weights; of a finished run `metrics.json` and `predictions.csv` are enough
for the table and for paired comparisons. `kept=FOLDER` takes them up where the runs themselves are
not there any more.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from qs3.errors import ConfigError, DataError
from qs3.report.tables.aggregate import FOLDER as KEPT
from qs3.report.tables.aggregate import Run, load_runs
from qs3.report.tables.cells import Table
from qs3.runs.metrics import FINISHED, METRICS, RunMetrics, read_metrics, write_metrics
from qs3.runs.predictions import FILE, Predictions, read_predictions, write_predictions
from qs3.utils.plural import counted

DIGITS = 4
"""Digits of the probabilities that are kept."""


def keep(table: Table, folder: str | Path) -> list[Path]:
    """Copy what a table needs of its finished runs; returns the folders that are new or changed.

    Layout: `<folder>/<experiment>/seed<seed>-<hash>/`, as below `paths.log_dir`. Of a run without
    predictions the result alone is kept.

    Raises:
        DataError: a run's predictions are damaged.
    """
    written = []
    for run in finished_runs(table):
        assert run.metrics is not None
        into = Path(folder) / run.experiment / f"seed{run.seed}-{run.hash}"
        if into.resolve() == run.folder.resolve():
            continue  # taken up from there
        into.mkdir(parents=True, exist_ok=True)
        before = {name: _bytes(into / name) for name in (METRICS, FILE)}
        if (run.folder / FILE).exists():
            said = read_predictions(run.folder / FILE)
            write_predictions(into / FILE, _rounded(said))
        if not _says_already(into, run.metrics):
            write_metrics(into, run.metrics)
        if before != {name: _bytes(into / name) for name in before}:
            written.append(into)
    return written


def finished_runs(table: Table) -> list[Run]:
    """Finished runs of all cells, each once."""
    found = {run.folder: run for c in table.cells if c.group for run in c.group.finished}
    return list(found.values())


def with_kept(runs: Iterable[Run], kept: str | Path | None) -> list[Run]:
    """Runs, and of those that are kept the ones that are not finished among them.

    Raises:
        ConfigError: there is no such folder.
    """
    runs = list(runs)
    if kept is None:
        return runs
    if not Path(kept).is_dir():
        raise ConfigError(f"kept={kept} is not there; `qs3 report keep` makes such a folder")
    done = {_name(run) for run in runs if run.status == FINISHED}
    added = [run for run in load_runs(kept) if _name(run) not in done]
    known = {_name(run) for run in added}
    return [run for run in runs if _name(run) not in known] + added


def unused(table: Table, kept: str | Path) -> str:
    """Why none of the kept runs is in the table, which looks as if none were run; "" if one is."""
    runs = [match for path in Path(kept).rglob("seed*") if (match := KEPT.fullmatch(path.name))]
    found = {cell.group.hash for cell in table.cells if cell.group}
    if any(match[2] in found for match in runs):
        return ""
    if not runs:
        return f"kept={kept} holds no runs"
    return (
        f"kept={kept}: none of its {counted(len(runs), 'run')} is of a cell that is shown here; "
        "they may have had other settings (overrides=, target=), or are of other columns or tables"
    )


def _says_already(folder: Path, metrics: RunMetrics) -> bool:
    """Whether it holds them; an older version did not write fields that have no value."""
    try:
        return read_metrics(folder) == metrics
    except DataError:
        return False


def _rounded(said: Predictions) -> Predictions:
    """With fewer digits where that leaves the most probable class as it is."""
    rounded = np.round(said.probabilities, DIGITS)
    same = rounded.argmax(axis=1) == said.predicted
    return replace(said, probabilities=np.where(same[:, None], rounded, said.probabilities))


def _name(run: Run) -> tuple[str, str, int | None]:
    return run.experiment, run.hash, run.seed


def _bytes(path: Path) -> bytes:
    return path.read_bytes() if path.exists() else b""
