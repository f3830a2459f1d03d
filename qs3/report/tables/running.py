"""Run what a table lacks: each missing seed of each cell, by processes of ours or a launcher.

A run that was finished before is not started; one that was interrupted goes on. A failure is told
at once, stops nothing, and is listed again at the end.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from qs3.config.location import python_command, typed
from qs3.config.quoting import override
from qs3.errors import ConfigError
from qs3.report.tables.table import Table

LAUNCHERS: Mapping[str, str] = {
    "joblib": "hydra.launcher.n_jobs",
    "submitit_local": "hydra.sweeper.at_once",
    "submitit_slurm": "hydra.launcher.array_parallelism",
    "slurm": "hydra.launcher.array_parallelism",
}
"""Of Hydra, and the setting of each that says how many jobs run at the same time."""

_POLL_S = 0.2
_TAIL = 12  # lines of a failed run's output that are shown
_ERROR = re.compile(r"[A-Z]\w*Error: ")


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
        return typed(f"python train.py {shlex.join(self.overrides)}")


@dataclass
class _Running:
    job: Job
    process: subprocess.Popen[bytes]
    output: Path
    began: float


def missing(
    table: Table, seeds: Sequence[int], rows: Sequence[str] = (), columns: Sequence[str] = ()
) -> list[Job]:
    """What is to be run: row by row, in each row seed by seed; what cells share, once.

    Args:
        table: with the runs that there are.
        seeds: that each cell should have.
        rows: only rows with one of these names, or, where no row has that name, whose name
            contains the word; all if empty.
        columns: likewise.

    Raises:
        ConfigError: `rows` fit no row, `columns` no column, or both together no cell.
    """
    cells = [c for c in table.cells if c.runnable and not c.missing]
    for kind, words in (("row", rows), ("column", columns)):
        names = dict.fromkeys(getattr(c, kind) for c in cells)
        chosen = _chosen(names, words)
        cells = [c for c in cells if getattr(c, kind) in chosen]
        if words and not cells:
            raise ConfigError(
                f"no {kind} of table {table.name} has {' or '.join(map(repr, words))} in its name; "
                f"{kind}s to run are {', '.join(names)}"
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


def _chosen(names: Iterable[str], words: Sequence[str]) -> set[str]:
    """Names that are meant by the words: the one that is the word, else all that contain it."""
    typed = {name: name.lower().replace("→", "->") for name in names}
    if not words:
        return set(typed)
    found: set[str] = set()
    for word in words:
        word = word.lower().replace("→", "->")
        exact = {name for name, text in typed.items() if text == word}
        found |= exact or {name for name, text in typed.items() if word in text}
    return found


def launch(
    jobs: Sequence[Job],
    launcher: str,
    at_once: int | None,
    log_dir: str,
    settings: Sequence[str] = (),
) -> int:
    """Run jobs as one multirun of `train.py`; returns its exit status.

    What becomes of them is written to the terminal by the multirun itself; with submitit, what a
    job says lies in `<log_dir>/.submitit`.

    Args:
        jobs: in the order of their numbers.
        launcher: one of `LAUNCHERS`.
        at_once: how many run at the same time; None: what the launcher does by itself.
        log_dir: of the runs.
        settings: further overrides of the launcher, such as "hydra.launcher.partition=gpu".
    """
    if not jobs:
        return 0
    limit = [] if at_once is None else [f"{LAUNCHERS[launcher]}={at_once}"]
    with tempfile.TemporaryDirectory(prefix="qs3-table-") as folder:
        file = Path(folder) / "jobs.json"
        file.write_text(json.dumps([list(job.overrides) for job in jobs]), encoding="utf-8")
        words = [
            override("paths.log_dir", log_dir),
            "hydra/sweeper=listed",
            override("hydra.sweeper.file", file),
            f"hydra/launcher={launcher}",
            *limit,
            *settings,
            "--multirun",
        ]
        command = [*python_command("train"), *words]
        return subprocess.run(command, stdin=subprocess.DEVNULL, check=False).returncode


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
            [*python_command("train"), *job.overrides],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
        )


def _outcome(one: _Running) -> str:
    seconds = time.monotonic() - one.began
    text = one.output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    if one.process.returncode:
        shown = "\n    ".join(_why(text))
        return f"{one.job.name}: FAILED after {seconds:.0f} s: {one.job.command}\n    {shown}"
    result = next((line.split("] ", 1)[-1] for line in reversed(text) if "accuracy" in line), "")
    return f"{one.job.name}: {result} ({seconds:.0f} s)"


def _why(lines: Sequence[str]) -> Sequence[str]:
    """The end of a failed run's output: from the error for people on, if there is one."""
    hydra = "Set the environment variable HYDRA_FULL_ERROR"
    lines = [line for line in lines if line and not line.startswith(hydra)]
    first = [i for i, line in enumerate(lines) if _ERROR.match(line)]
    return lines[first[-1] : first[-1] + _TAIL] if first else lines[-_TAIL:]
