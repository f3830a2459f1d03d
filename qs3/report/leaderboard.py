"""A user's own method by the rules of `table=leaderboard`: `qs3 leaderboard method=my_method.py`.

The method's file becomes one more row of that table: the experiment, the columns and the seeds are
the table's, so it is trained, evaluated and compared as all other rows are.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from qs3.config.compose import composed, override
from qs3.config.hashing import file_sha256
from qs3.config.hydra import build
from qs3.errors import ConfigError
from qs3.report.comparison import against
from qs3.report.comparison import text as compared_text
from qs3.report.formats import markdown
from qs3.report.table import Table

ALONE = "experiment=leaderboard"
WITH_ROUNDS = "protocol.epochs=10 protocol.steps=180"
"""What rows with rounds have in addition to `ALONE`: as many steps in all as the others."""
SURE = {"sd": "selftraining.selector.growth=0.5"}
"""What a scheme has in the table's rows, because there are two rounds, not as many as its own."""


def own_row(
    file: Path, name: str | None, selftraining: str, settings: Sequence[str] = ()
) -> dict[str, Any]:
    """The row of a method's file, as one in the table's file.

    Args:
        file: of the method; its SHA-256 is in the row's command, so the runs are of this content.
        name: of the row; None: the file's.
        selftraining: of conf/selftraining; "none".
        settings: of the class, such as "method.weight=0.5".
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
    """Check that all rows follow the leaderboard's rules, and that the file is a method.

    Raises:
        ConfigError: a row is of another experiment, or the file is not a method
            (`qs3.methods.own`).
    """
    for row, cells in table.rows.items():
        if row != name and any(c.overrides and ALONE not in c.overrides for c in cells):
            raise ConfigError(
                f"table={table.name}: its row {row!r} is not of {ALONE}, so it has other steps or "
                "points than yours would have"
            )
    cfg = composed("train", *next(c.overrides for c in table.rows[name] if c.overrides))
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
