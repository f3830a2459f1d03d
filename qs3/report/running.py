"""Run what a table lacks: each missing seed of each cell, one process each, some at a time.

A run that was finished before is not started; one that was interrupted goes on. A failure is told
at once, stops nothing, and is listed again at the end.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from qs3.errors import ConfigError
from qs3.report.tables import Cell, Table

ROOT = Path(__file__).parents[2]
_POLL_S = 0.2
_TAIL = 12  # lines of a failed run's output that are shown


@dataclass(frozen=True)
class Job:
    """One seed of one cell.

    Attributes:
        name: row, column and seed, for people.
        overrides: of train.py.
    """

    name: str
    overrides: tuple[str, ...]

    @property
    def command(self) -> str:
        """What a user would type."""
        return f"python train.py {shlex.join(self.overrides)}"


@dataclass
class _Running:
    job: Job
    process: subprocess.Popen[bytes]
    output: Path
    began: float


def missing(table: Table, seeds: Sequence[int], rows: Sequence[str] = ()) -> list[Job]:
    """What is to be run: row by row, in each row seed by seed; what cells share, once.

    Args:
        table: with the runs that there are.
        seeds: that each cell should have.
        rows: only rows whose name contains one of these words; all if empty.

    Raises:
        ConfigError: `rows` fit no row.
    """
    cells = [c for c in table.cells if c.runnable and not c.missing and _chosen(c, rows)]
    if rows and not cells:
        raise ConfigError(
            f"no row of table {table.name} has {' or '.join(map(repr, rows))} in its name; rows "
            f"to run are {', '.join(dict.fromkeys(c.row for c in table.cells if c.runnable))}"
        )
    jobs: dict[tuple[str, ...], Job] = {}
    for cell in cells:
        done = set(cell.group.seeds) if cell.group else set()
        for seed in seeds:
            if seed not in done:
                overrides = (*cell.overrides, f"seed={seed}")
                where = f"{cell.row}, {cell.column}" if len(table.columns) > 1 else cell.row
                jobs.setdefault(overrides, Job(f"{where}, seed {seed}", overrides))
    return list(jobs.values())


def _chosen(cell: Cell, rows: Sequence[str]) -> bool:
    return not rows or any(word.lower() in cell.row.lower() for word in rows)


def run_all(
    jobs: Sequence[Job],
    at_once: int,
    say: Callable[[str], None],
    start: Callable[[Job, Path], subprocess.Popen[bytes]] | None = None,
) -> list[Job]:
    """Run jobs, `at_once` at a time; returns those that failed.

    Args:
        jobs: in the order in which they are started.
        at_once: number of processes; with two, each pair has other seeds, mostly, and so no
            warm-up in common.
        say: gets a line for the user.
        start: starts a job, its output going to a file; by default `train.py`.
    """
    start = start or _start
    waiting, failed, done = list(jobs), [], 0
    running: list[_Running] = []
    with tempfile.TemporaryDirectory(prefix="qs3-table-") as folder:
        try:
            while waiting or running:
                while waiting and len(running) < at_once:
                    job = waiting.pop(0)
                    output = Path(folder) / f"{len(jobs) - len(waiting)}.txt"
                    running.append(_Running(job, start(job, output), output, time.monotonic()))
                time.sleep(_POLL_S)
                for one in [one for one in running if one.process.poll() is not None]:
                    running.remove(one)
                    done += 1
                    if one.process.returncode:
                        failed.append(one.job)
                    say(f"[{done}/{len(jobs)}] {_outcome(one)}")
        finally:  # Ctrl-C and the like: runs continue from their last epoch when called again
            for one in running:
                one.process.terminate()
            for one in running:
                one.process.wait()
    return failed


def _start(job: Job, output: Path) -> subprocess.Popen[bytes]:
    with open(output, "wb") as file:
        return subprocess.Popen(
            [sys.executable, str(ROOT / "train.py"), *job.overrides],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
        )


def _outcome(one: _Running) -> str:
    seconds = time.monotonic() - one.began
    text = one.output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    if one.process.returncode:
        shown = "\n    ".join(text[-_TAIL:])
        return f"{one.job.name}: FAILED after {seconds:.0f} s: {one.job.command}\n    {shown}"
    result = next((line.split("] ", 1)[-1] for line in reversed(text) if "accuracy" in line), "")
    return f"{one.job.name}: {result} ({seconds:.0f} s)"
