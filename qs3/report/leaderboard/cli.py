"""A user's own method by the rules of `table=leaderboard`: `qs3 leaderboard method=my_method.py`.

The method's file becomes one more row of that table: the experiment, the columns and the seeds are
the table's, so it is trained, evaluated and compared as all other rows are.
"""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qs3.config.compose import choices
from qs3.config.location import typed
from qs3.errors import ConfigError
from qs3.utils.cli import Command, Option, path, several, text, whole
from qs3.utils.plural import counted

if TYPE_CHECKING:
    from qs3.report.tables.cells import Table

ALONE = "experiment=leaderboard"
WITH_ROUNDS = "protocol.epochs=10 protocol.steps=180"
"""What rows with rounds have beside `ALONE`: as many steps in all as the others."""
SURE = {"sd": "selftraining.selector.growth=0.5"}
"""What a scheme has in the table's rows, because there are two rounds, not as many as its own."""


def _leaderboard(
    method: Path,
    name: str | None,
    selftraining: str,
    table: str,
    seeds: Sequence[int],
    columns: Sequence[str],
    jobs: int | None,
    log_dir: str,
    data_dir: str | None,
    overrides: str,
    kept: str | None,
    out: str | None,
    more: Sequence[str],
) -> int:
    """Train what the row lacks, and print it beside the rows that are there."""
    from qs3.config.quoting import override
    from qs3.report.tables.formats import csv_text, latex, markdown
    from qs3.report.tables.keeping import unused
    from qs3.report.tables.overrides import file_name
    from qs3.report.tables.running import launch, missing
    from qs3.report.tables.saving import save
    from qs3.report.tables.table import build_table

    row = own_row(method, name, selftraining, more)
    extra = shlex.split(overrides)
    extra += [override("paths.data_dir", data_dir)] if data_dir else []

    def built(runs: bool = True) -> Table:
        return build_table(table, log_dir, extra, None, kept, [row], columns, runs)

    plain, name = built(runs=False), row["name"]
    _check_rules(plain, name)
    _check_class(plain, name)
    before = built()  # looks every cell up, which takes a while
    if kept and (why := unused(before, kept)):
        print(f"note: {why}", file=sys.stderr)
    todo = missing(before, seeds, [name], columns)
    print(f"{name}: {counted(len(todo), 'run')} to do", flush=True)
    status = launch(todo, "joblib" if (jobs or 1) > 1 else "basic", jobs, log_dir)
    shown = beside(built(), name)
    if overrides:
        also = f"beside the rules all runs of this page have: {overrides}"
        shown = replace(shown, notes=(*shown.notes, also))
    place = file_name(shown.name, _file_name(name), columns=columns, overrides=overrides)
    at = Path(out or Path(log_dir) / "tables") / place
    page = markdown(shown) + _intervals(shown, name)
    said = save(at, {".md": page, ".csv": csv_text(shown), ".tex": latex(shown)})
    print(f"{page}\n{said}")
    return status


def own_row(
    file: Path, name: str | None, selftraining: str, settings: Sequence[str] = ()
) -> dict[str, Any]:
    """The row of a method's file, as one in the table's file.

    Args:
        file: of the method; its SHA-256 is in the row's command, so the runs are of this content.
        name: of the row; None: the file's.
        selftraining: of conf/selftraining; "none".
        settings: of the class, such as "method.weight=0.5".

    Raises:
        MissingDataError: there is no such file.
        ConfigError: there is no such selftraining.
    """
    from qs3.config.compose import composed
    from qs3.config.hashing import file_sha256
    from qs3.config.quoting import override

    if selftraining not in choices("selftraining"):
        known = ", ".join(choices("selftraining"))
        raise ConfigError(f"selftraining={selftraining} is not there; there are {known}")
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


def beside(table: Table, name: str) -> Table:
    """The row `name` first, and below it the rows with runs; of the columns those with some.

    Averages that were published of all columns are left out where not all are shown.
    """
    rows = {name: table.rows[name]}
    rows |= {row: cells for row, cells in table.rows.items() if table.groups(row)}
    kept = [
        i
        for i in range(len(table.columns))
        if not table.ours(i) or any((c := cells[i]) and c.group for cells in rows.values())
    ]
    return replace(
        table,
        title=f"{table.title}: {name}",
        columns=tuple(table.columns[i] for i in kept),
        rows={row: tuple(cells[i] for i in kept) for row, cells in rows.items()},
        averages=table.averages if len(kept) == len(table.columns) else {},
    )


def _file_name(row: str) -> str:
    """A row's name as a part of a file's: two rows of one method's file have files of their own."""
    return re.sub(r"[^\w.]+", "-", row).strip("-.") or "row"


def _check_rules(table: Table, name: str) -> None:
    """Whether the other rows are trained by the rules that the row `name` is trained by.

    Raises:
        ConfigError: one is of another experiment, with other steps or points.
    """
    for row, cells in table.rows.items():
        if row != name and any(c and c.runnable and ALONE not in c.overrides for c in cells):
            raise ConfigError(
                f"table={table.name}: its row {row!r} is not of {ALONE}, so it has other steps or "
                "points than yours would have. By that table's own rules yours is trained by: "
                + typed("python train.py experiment=NAME method=own method.file=FILE")
            )


def _check_class(table: Table, name: str) -> None:
    """Build the method as each run will, and try its loss on random clouds, before any has begun.

    Raises:
        ConfigError: the file is not a method (`qs3.methods.own`), its loss fails, or no column is
            for runs.
    """
    from qs3.config.compose import composed
    from qs3.config.hydra import build
    from qs3.methods.own import try_step

    cells = [cell for cell in table.rows[name] if cell and cell.runnable]
    if not cells:
        shown = ", ".join(map(repr, table.columns))
        raise ConfigError(f"{shown} of table {table.name} are published figures alone")
    cell = cells[0]
    cfg = composed("train", *cell.overrides)
    method, net = build(cfg.method), build(cfg.model)
    try_step(method, net, cfg.num_classes, cfg.data.points)


def _intervals(table: Table, name: str) -> str:
    """The row minus each other row, paired."""
    from qs3.report.tables.comparison import minus_each
    from qs3.report.tables.comparison import text as shown

    found = minus_each(table, name)
    if any(one.differences for one in found):
        return f"\n{name} minus\n\n{shown(found, markdown=True)}"
    return "".join(f"\n{name} minus {one.name}: {one.why}\n" for one in found)


LEADERBOARD = Command(
    "qs3 leaderboard",
    "a method of your own, trained and shown by the rules of table=leaderboard",
    _leaderboard,
    (
        Option("method", path("FILE"), "Python, with one class derived from Method", None, True),
        Option("name", text("NAME"), "of its row (default: the file's)"),
        Option("selftraining", text("NAME"), "of conf/selftraining, after the warm-up", "none"),
        Option(
            "table",
            text("NAME"),
            f"whose rows and columns, all of {ALONE}: of conf/table, or a file",
            "leaderboard",
        ),
        Option("seeds", several(whole(0)), "default 0,1,2", ()),
        Option("columns", several(text("WORD")), "only columns with it in their name", ()),
        Option("jobs", whole(), "runs at the same time (default 1)"),
        Option(
            "log_dir", text("FOLDER"), "paths.log_dir of the runs, these and the table's", "logs"
        ),
        Option("data_dir", text("FOLDER"), "paths.data_dir of the runs (default: data)"),
        Option(
            "overrides",
            text('"A=B ..."'),
            "more settings of all runs; COLUMN:A=B of a column's",
            "",
        ),
        Option(
            "kept", text("FOLDER"), "results that `qs3 report keep` has kept: shown, not trained"
        ),
        Option("out", text("FOLDER"), "where the files go (default LOG_DIR/tables)"),
    ),
    (
        "qs3 leaderboard method=my_method.py",
        'qs3 leaderboard method=my_method.py method.weight=0.5 name="Mine, w = 0.5"',
        'qs3 leaderboard method=my_method.py columns="S -> K" seeds=0 selftraining=qbst',
    ),
    about="""
The file is imported, which runs it: name one that you trust. Its loss is tried on four random
clouds before any run begins; the runs need the data of the chosen columns. An edited file is
another row, whose runs begin anew; the same command goes on with interrupted runs and trains
nothing twice.
Rules and an example: docs/how-to/leaderboard.md. The other rows are trained by
`qs3 report train table=leaderboard`.
""",
    others={"method.": "settings of the class"},
)
