"""The page's figures on real objects are those of the tables, and the tables' of the kept runs.

Where runs were kept since: `qs3 report table` of each column and `compare` of R -> A, as asked
below, with `out=` a folder, whose CSV files go to docs/results/leaderboard; then `page_lines()`
are the page's.
"""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from tests.commands import ROOT, main

KEPT = ROOT / "docs" / "results" / "leaderboard"
PAGE = ROOT / "docs" / "how-to" / "leaderboard.md"
OURS = "Twins (ours)"
COLUMNS = ("R -> A", "R -> A0", "S -> K", "S -> C")
SETTINGS = (
    *("table=leaderboard", f"kept={KEPT}", "overrides=report.pictures=false"),
    "log_dir=nowhere",
)


def _rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text("utf-8").splitlines()))


def _file(column: str, more: str = "") -> str:
    return f"leaderboard-{column.replace(' -> ', '-')}{more}.csv"


def page_lines() -> list[str]:
    """R → A's table as the page has it: means, and what Twins is above each row."""
    table = [row for row in _rows(KEPT / _file("R -> A")) if row["column"] == "R → A"]
    compared = _rows(KEPT / _file("R -> A", "-compared"))
    figures = {(row["row"], row["metric"]): row for row in table}
    above = {
        (row["name"].removesuffix(", R → A"), row["metric"]): row
        for row in compared
        if row["clouds"] == "all"
    }
    lines = []
    for name in dict.fromkeys(row["row"] for row in table):
        one = figures[name, "accuracy"]
        if not one["mean"]:
            continue
        cells = [name]
        for metric in ("accuracy", "balanced accuracy"):
            row = figures[name, metric]
            sem = f" ± {float(row['sem']):.1f}" if int(row["n"]) > 1 else ""
            cells.append(f"{float(row['mean']):.1f}{sem}")
        cells.append(one["n"])
        for metric in ("accuracy", "balanced accuracy"):
            row = above.get((name, metric))
            cells.append(_ours_minus(row) if row else "")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _ours_minus(row: dict[str, str]) -> str:
    middle, low, high = (-float(row[key]) for key in ("difference", "high", "low"))
    return f"{middle:+.1f} [{low:.1f}, {high:.1f}]"


def test_the_page_has_the_table_s_figures() -> None:
    text = PAGE.read_text("utf-8")
    shown = text.partition("<!-- R-A -->\n")[2].partition("<!-- /R-A -->")[0]
    assert shown.splitlines()[2:] == page_lines()


@pytest.mark.parametrize("column", COLUMNS)
def test_a_table_s_figures_are_those_of_the_kept_runs(column: str, tmp_path: Path) -> None:
    asked = ["table", *SETTINGS, f"columns={column}", f"out={tmp_path}"]
    assert main(["report", *asked]) == 0
    assert _figures(tmp_path / _file(column)) == _figures(KEPT / _file(column))


def test_the_differences_are_those_of_the_kept_runs(tmp_path: Path) -> None:
    asked = ["compare", *SETTINGS, "columns=R -> A", f"base={OURS}", f"out={tmp_path}"]
    assert main(["report", *asked]) == 0
    name = _file("R -> A", "-compared")
    assert _rows(tmp_path / name) == _rows(KEPT / name)


def _figures(path: Path) -> list[list[str]]:
    """Without what a run cost, and its command."""
    keys = ("row", "column", "metric", "mean", "sem", "n", "seeds", "hash")
    return [[row[key] for key in keys] for row in _rows(path)]
