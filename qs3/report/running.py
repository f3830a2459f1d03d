"""Run what a table lacks: each missing seed of each cell, by one of Hydra's launchers.

A run that was finished before is not started; one that was interrupted goes on. A failure stops
nothing, and is listed at the end.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from qs3.config.compose import override
from qs3.config.location import python_command
from qs3.report.spec import chosen
from qs3.report.table import Table

LAUNCHERS: Mapping[str, str | None] = {
    "basic": None,
    "joblib": "hydra.launcher.n_jobs",
    "ray": "hydra.launcher.jobs",
    "submitit_local": "hydra.sweeper.at_once",
    "submitit_slurm": "hydra.launcher.array_parallelism",
    "slurm": "hydra.launcher.array_parallelism",
}
"""Hydra's launchers, and the setting of each for how many jobs run at the same time, if any."""


class Job(NamedTuple):
    """One seed of one cell: row, column and seed, for people, and the overrides of train.py."""

    name: str
    overrides: tuple[str, ...]


def missing(table: Table, seeds: Sequence[int] = (), rows: Sequence[str] = ()) -> list[Job]:
    """What is to be run: row by row, in each row seed by seed; what cells share, once.

    Cells whose file says `first: true` come before the others: long runs that would otherwise be
    left alone at the end of several at a time.

    Args:
        seeds: that each cell should have; none: those that the table wants.
        rows: only those that these words mean (`spec.chosen`); all if empty.
    """
    meant = chosen(table.rows, rows)
    jobs: dict[tuple[str, ...], Job] = {}
    for cell in sorted(table.cells, key=lambda cell: not cell.entry.first):
        if not cell.overrides or cell.row not in meant:
            continue
        for seed in seeds or cell.seeds:
            if seed not in cell.runs.seeds:
                overrides = (*cell.overrides, f"seed={seed}")
                where = f"{cell.row}, {cell.column}" if len(table.columns) > 1 else cell.row
                jobs.setdefault(overrides, Job(f"{where}, seed {seed}", overrides))
    return list(jobs.values())


def launch(
    jobs: Sequence[Job],
    launcher: str,
    at_once: int | None,
    log_dir: str,
    settings: Sequence[str] = (),
) -> int:
    """Run jobs, in order, as one multirun of `train.py`; returns its exit status.

    What becomes of them is written to the terminal by the multirun itself, with the failures last;
    with submitit, what a job prints lies in `<log_dir>/.submitit`.

    Args:
        launcher: one of `LAUNCHERS`.
        at_once: how many run at the same time; None: what the launcher does by itself.
        settings: further overrides of the launcher, such as "hydra.launcher.partition=gpu".
    """
    if not jobs:
        return 0
    key = LAUNCHERS[launcher]
    with tempfile.TemporaryDirectory(prefix="qs3-table-") as folder:
        file = Path(folder) / "jobs.json"
        file.write_text(json.dumps([job.overrides for job in jobs]), encoding="utf-8")
        words = [
            override("paths.log_dir", log_dir),
            "hydra/sweeper=listed",
            override("hydra.sweeper.file", file),
            f"hydra/launcher={launcher}",
            *([f"{key}={at_once}"] if key and at_once else []),
            *settings,
            "--multirun",
        ]
        command = [*python_command("train"), *words]
        return subprocess.run(command, stdin=subprocess.DEVNULL, check=False).returncode
