"""Run what a table lacks, and a user's own method as one more row of `table=leaderboard`.

Each missing seed of each cell is run by one of Hydra's launchers. A run that was finished before is
not started; one that was interrupted goes on. A failure stops nothing, and is listed at the end.

The experiment, the columns and the seeds of a row of one's own are the table's, so the method is
trained, evaluated and compared as all other rows are.
"""

import json
import shlex
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from qs3.config.compose import composed, override
from qs3.config.hydra import build, file_sha256
from qs3.config.location import python_command
from qs3.errors import ConfigError
from qs3.report.comparison import against
from qs3.report.comparison import text as compared_text
from qs3.report.formats import markdown
from qs3.report.spec import chosen
from qs3.report.table import Table, composed_of

_AT_ONCE = {"joblib": "n_jobs", "ray": "jobs", "slurm": "array_parallelism"}
"""Hydra's launchers, and the setting of each for how many jobs run at the same time."""

ALONE = "experiment=leaderboard"
WITH_ROUNDS = "protocol.epochs=10 protocol.steps=180"
"""What rows with rounds have in addition to `ALONE`: as many steps in all as the others."""
SURE = {"sd": "selftraining.selector.growth=0.5"}
"""What a scheme has in the table's rows, because there are two rounds, not as many as its own."""


class Job(NamedTuple):
    """One seed of one cell: row, column and seed, for people, and the overrides of train.py."""

    name: str
    overrides: tuple[str, ...]


def missing(table: Table, seeds: Sequence[int] = (), rows: Sequence[str] = ()) -> list[Job]:
    """What is to be run, cell by cell (those with `first: true` before the others); each job once.

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
    launcher: Literal["joblib", "ray", "slurm"] | None,
    at_once: int | None,
    log_dir: str,
    settings: Sequence[str] = (),
) -> int:
    """Run jobs, in order, as one multirun of `train.py`; returns its exit status.

    `at_once` at the same time (None: what the launcher does by itself); without a launcher one
    after the other, or by joblib if several at once. With SLURM, what a job prints lies in
    `<log_dir>/.submitit`. Further settings are of the launcher.
    """
    if not jobs:
        return 0
    launcher = launcher or ("joblib" if (at_once or 1) > 1 else None)
    with tempfile.TemporaryDirectory(prefix="qs3-table-") as folder:
        file = Path(folder) / "jobs.json"
        file.write_text(json.dumps([job.overrides for job in jobs]), encoding="utf-8")
        words = [
            override("paths.log_dir", log_dir),
            "hydra/sweeper=listed",
            override("hydra.sweeper.file", file),
            f"hydra/launcher={launcher or 'basic'}",
            *([f"hydra.launcher.{_AT_ONCE[launcher]}={at_once}"] if launcher and at_once else []),
            *settings,
            "--multirun",
        ]
        command = [*python_command("train"), *words]
        return subprocess.run(command, stdin=subprocess.DEVNULL, check=False).returncode


def own_row(
    file: Path, name: str | None, selftraining: str, settings: Sequence[str] = ()
) -> dict[str, Any]:
    """The row of a method's file, as one in the table's file; it names the file's SHA-256.

    `settings` are of the class, such as "method.weight=0.5".
    """
    words = [
        *(ALONE, "method=own", override("method.file", file)),
        f"method.sha256={file_sha256(str(file))}",
        *(f"+{word}" for word in settings),
    ]
    if selftraining != "none":
        scheme = f"selftraining={selftraining}"
        words += [scheme, *SURE.get(selftraining, "").split()]
        if composed("train", ALONE, scheme).selftraining.get("theta") == 0:
            words.append("selftraining.share=null")  # it has thresholds of its own
        words += WITH_ROUNDS.split()
    return {"name": name or file.stem, "run": shlex.join(words)}


def check_row(table: Table, name: str) -> None:
    """Check that all rows follow the leaderboard's rules, and the file (`qs3.methods.own`)."""
    for row, cells in table.rows.items():
        if row != name and any(c.overrides and ALONE not in c.overrides for c in cells):
            raise ConfigError(f"table={table.name}: its row {row!r} is not of {ALONE}")
    _, cfg = composed_of(next(cell for cell in table.rows[name] if cell.overrides))
    build(cfg.method)


def first_row(table: Table, name: str) -> Table:
    """The row `name` first, and below it the rows with runs."""
    rows = {name: table.rows[name]}
    rows |= {row: cells for row, cells in table.rows.items() if any(c.runs.seeds for c in cells)}
    return replace(table, title=f"{table.title}: {name}", rows=rows)


def page(table: Table, name: str) -> str:
    """The table, and the row minus each other row that has runs, paired."""
    found = [one for one in against(table, name, reverse=True) if "not run" not in one.why]
    return f"{markdown(table)}\n{name} minus\n\n```\n{compared_text(found)}```\n"
