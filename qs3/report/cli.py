"""`qs3 report`: tables, what they lack, comparisons, pictures."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qs3.config.compose import choices
from qs3.errors import ConfigError
from qs3.utils.cli import Command, Option, several, text, whole
from qs3.utils.plural import counted

if TYPE_CHECKING:
    from qs3.report.tables.cells import Table

_LAUNCHER = "hydra.launcher."


def _built(
    table: str,
    log_dir: str | None,
    data_dir: str | None,
    target: str | None,
    overrides: str,
    kept: str | None = None,
    runs: bool = True,
    columns: Sequence[str] = (),
    row: str | None = None,
) -> Table:
    """The table that the options ask for, with our runs.

    `runs`: there are some, one may think; `row`: a word for one that it has to have.
    """
    from qs3.config.quoting import override
    from qs3.report.tables.keeping import unused
    from qs3.report.tables.overrides import row_of
    from qs3.report.tables.table import build_table

    extra = shlex.split(overrides)
    extra += [override("paths.data_dir", data_dir)] if data_dir else []
    if runs and not kept and log_dir and not Path(log_dir).is_dir():
        raise ConfigError(f"log_dir={log_dir} is not there; it is the paths.log_dir of the runs")
    if row is not None:  # before cells are looked up, which takes a while
        plain = build_table(table, "logs", extra, target, columns=columns, runs=False)
        row_of(plain.rows, row, plain.name)
    built = build_table(table, log_dir or "logs", extra, target, kept, columns=columns)
    if kept and (why := unused(built, kept)):
        print(f"note: {why}", file=sys.stderr)
    return built


def _saved_at(table: Table, out: str | None, given: dict[str, Any]) -> Path:
    """Where a table's files go, without suffix."""
    from qs3.report.tables.overrides import file_name

    shown = {key: given[key] for key in ("columns", "overrides")}
    name = file_name(table.name, given["target"], **shown)
    return Path(out or Path(given["log_dir"] or "logs") / "tables") / name


def _table(out: str | None, **given: Any) -> None:
    from qs3.report.tables.formats import csv_text, latex, markdown
    from qs3.report.tables.saving import save

    table = _built(**given)
    if settings := given["overrides"]:
        table = replace(table, notes=(*table.notes, f"overrides of the runs: `{settings}`"))
    texts = {".md": markdown(table), ".csv": csv_text(table), ".tex": latex(table)}
    said = save(_saved_at(table, out, given), texts)
    print(texts[".md"])
    print(said)


def _train(
    seeds: Sequence[int],
    rows: Sequence[str],
    columns: Sequence[str],
    jobs: int | None,
    launcher: str | None,
    more: Sequence[str],
    **given: Any,
) -> int:
    from qs3.report.tables.running import LAUNCHERS, launch, missing

    if launcher not in (*LAUNCHERS, None) or (more and launcher is None):
        what = f"launcher={launcher}" if launcher else f"{more[0]} needs a launcher"
        raise ConfigError(f"{what}; set launcher={'|'.join(LAUNCHERS)}")
    only = () if given["target"] else columns  # another target renames them
    table = _built(**given, runs=False, columns=only)
    todo = missing(table, seeds, rows, columns)
    print(f"table {table.name}: {counted(len(todo), 'run')} to do", flush=True)
    launcher = launcher or ("joblib" if (jobs or 1) > 1 else "basic")
    status = launch(todo, launcher, jobs, given["log_dir"] or "logs", more)
    if not status:
        shown = {**given, "columns": ",".join(only)}
        print("next: qs3 report", shlex.join(f"{key}={one}" for key, one in shown.items() if one))
    return status


def _keep(into: str, **given: Any) -> None:
    from qs3.report.tables.keeping import finished_runs, keep

    table = _built(**given)
    written = keep(table, into)
    for folder in written:
        print(f"kept {folder}")
    runs = counted(len(finished_runs(table)), "finished run")
    print(f"{runs} of table {table.name}, {len(written)} new")


def _compare(base: str | None, out: str | None, **given: Any) -> None:
    from qs3.report.tables import comparison
    from qs3.report.tables.overrides import row_of

    table = _built(**given, row=base or "")
    base = row_of(table.rows, base or "", table.name)
    found, at = comparison.against(table, base), _saved_at(table, out, given)
    _save(f"{at}-compared", table, found, base)


def _effects(out: str | None, **given: Any) -> None:
    from qs3.report.tables import comparison

    table = _built(**given)
    found, at = comparison.effects(table), _saved_at(table, out, given)
    if not found:
        raise ConfigError(f"table {table.name} has no two columns or rows with runs of ours")
    _save(f"{at}-effects", table, found)


def _save(at: str, table: Table, found: Sequence[Any], base: str = "") -> None:
    from qs3.report.tables.comparison import csv_text, text
    from qs3.report.tables.saving import save

    page = text(found, base, markdown=True, table=table)
    said = save(at, {".md": page, ".csv": csv_text(found, base)})
    print(text(found, base, table=table))
    print(said)


_TABLE = (
    Option(
        "table",
        text("NAME|FILE"),
        "of conf/table, or a file",
        None,
        True,
        partial(choices, "table"),
    ),
    Option("log_dir", text("FOLDER"), "paths.log_dir of the runs (default logs)"),
    Option("data_dir", text("FOLDER"), "paths.data_dir of the runs (default: data)"),
    Option("target", text("NAME"), "another target domain for all of the table"),
    Option(
        "overrides", text('"A=B ..."'), "more settings of all runs; COLUMN:A=B of a column's", ""
    ),
    Option("kept", text("FOLDER"), "results that `qs3 report keep` has kept: shown, not trained"),
    Option("columns", several(text("WORD")), "only columns of this name, or with it in theirs", ()),
)
_OUT = Option("out", text("FOLDER"), "where the files go (default LOG_DIR/tables)")

TABLE = Command(
    "qs3 report table",
    "a table of runs, printed and saved as .md, .csv and .tex",
    _table,
    (*_TABLE, _OUT),
    (
        "qs3 report table=uda",
        'qs3 report table=leaderboard columns="S -> K"',
        'qs3 report table=uda target=kinectsim10 overrides="trainer=gpu data.points=512"',
    ),
)

TRAIN = Command(
    "qs3 report train",
    "train what a table lacks, seed by seed; called again it goes on",
    _train,
    (
        *_TABLE,
        Option("seeds", several(whole(0)), "of each cell (default: the table's, mostly 0,1,2)", ()),
        Option("rows", several(text("WORD")), "only rows of this name, or with it in theirs", ()),
        Option("jobs", whole(), "runs at the same time (default 1, or what the launcher does)"),
        Option("launcher", text("NAME"), "of Hydra: joblib, submitit_local, slurm or ray"),
    ),
    (
        "qs3 report train table=cad10",
        'qs3 report train table=self_training rows=qbst columns="S -> D" seeds=0',
        "qs3 report train table=uda launcher=joblib jobs=4",
        "qs3 report train table=uda launcher=slurm jobs=16 hydra.launcher.partition=gpu",
    ),
    others={
        _LAUNCHER: "settings of the launcher",
        f"+{_LAUNCHER}": "such as +hydra.launcher.additional_parameters.mail-type=END",
    },
)

KEEP = Command(
    "qs3 report keep",
    "keep the results of a table's finished runs, small enough to commit",
    _keep,
    (*_TABLE, Option("into", text("FOLDER"), "where they go", required=True)),
    (
        "qs3 report keep table=real into=docs/results/real",
        "qs3 report table=real kept=docs/results/real",
    ),
)

_PAIRED = """
Paired over test clouds and the seeds that both have, two at least; accuracy and balanced accuracy,
and both of each tier where the target has tiers. Intervals are at 95 %, over seeds and what clouds
share: meshes, rooms or blocks of frames. * marks those that do not reach 0.
"""

COMPARE = Command(
    "qs3 report compare",
    "the difference of each row to one row, with its interval",
    _compare,
    (
        *_TABLE,
        Option("base", text("ROW"), "the row to compare with: its name, or a word of it alone"),
        _OUT,
    ),
    ('qs3 report compare table=cad10 base="source only"',),
    about=_PAIRED,
)

EFFECTS = Command(
    "qs3 report effects",
    "differences between columns over all rows, of rows over columns, or of factors",
    _effects,
    (*_TABLE, _OUT),
    ("qs3 report effects table=factorial", "qs3 report effects table=headline"),
    about=_PAIRED,
)
