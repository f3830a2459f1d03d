"""The page's figures on real objects are those of the tables, and the tables' of the kept runs.

Where runs were kept since: `qs3 report table` of each column and `compare` of R -> A, as asked
below, with `out=` a folder, whose CSV files go to docs/results/leaderboard; then `page_lines()` and
`development_lines()` are the page's. Likewise of docs/results/leaderboard_second and
leaderboard_third, whose runs learnt from other copies of R.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from qs3.runs.metrics import METRICS, read_metrics
from tests.running import ROOT, main

KEPT = ROOT / "docs" / "results" / "leaderboard"
SECOND = ROOT / "docs" / "results" / "leaderboard_second"
THIRD = ROOT / "docs" / "results" / "leaderboard_third"
PAGE = ROOT / "docs" / "results" / "leaderboard.md"
DEVELOPMENT = ("R -> A0", "S -> C", "S -> K")
COLUMNS = (
    *((KEPT, "R -> A"), (KEPT, "R -> A0"), (KEPT, "S -> K"), (KEPT, "S -> C")),
    (SECOND, "R -> A"),
    (THIRD, "R -> A"),
)
OURS = {
    KEPT: "Twins (ours)",
    SECOND: "alpha-BN and estimated shares, batches of 32 (ours)",
    THIRD: "alpha-BN and estimated shares, batches of 32 (ours)",
}


def _rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text("utf-8").splitlines()))


def _file(column: str, more: str = "") -> str:
    return f"leaderboard-{column.replace(' -> ', '-')}{more}.csv"


def _settings(kept: Path) -> list[str]:
    quiet = ["overrides=report.pictures=false", "log_dir=nowhere"]
    return ["table=leaderboard", f"kept={kept}", *quiet]


def page_lines(kept: Path = KEPT) -> list[str]:
    """R → A's table as the page has it: means, and what `OURS` is above each row."""
    table = [row for row in _rows(kept / _file("R -> A")) if row["column"] == "R → A"]
    compared = _rows(kept / _file("R -> A", "-compared"))
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


def development_lines() -> list[str]:
    """The three other columns' means, accuracy / balanced accuracy."""
    cells: dict[str, dict[str, list[str]]] = {}
    for column in DEVELOPMENT:
        for row in _rows(KEPT / _file(column)):
            if row["mean"] and row["column"] == column.replace("->", "→"):
                shown = cells.setdefault(row["row"], {}).setdefault(column, [])
                shown.append(f"{float(row['mean']):.1f}")
    lines = []
    for name, found in cells.items():
        means = [" / ".join(found.get(column, ())) for column in DEVELOPMENT]
        lines.append(f"| {name} | {' | '.join(means)} |")
    return lines


def _shown(mark: str) -> list[str]:
    text = PAGE.read_text("utf-8")
    shown = text.partition(f"<!-- {mark} -->\n")[2].partition(f"<!-- /{mark} -->")[0]
    return shown.splitlines()[2:]


@pytest.mark.parametrize(
    ("kept", "mark"), [(KEPT, "R-A"), (SECOND, "R-A-second"), (THIRD, "R-A-third")]
)
def test_the_page_has_the_table_s_figures(kept: Path, mark: str) -> None:
    assert _shown(mark) == page_lines(kept)


def test_the_page_has_the_figures_of_the_columns_for_development() -> None:
    assert _shown("development") == development_lines()


@pytest.mark.parametrize(("kept", "column"), COLUMNS)
def test_a_table_s_figures_are_those_of_the_kept_runs(
    kept: Path, column: str, tmp_path: Path
) -> None:
    asked = ["table", *_settings(kept), f"columns={column}", f"out={tmp_path}"]
    assert main(["report", *asked]) == 0
    assert _figures(tmp_path / _file(column)) == _figures(kept / _file(column))


@pytest.mark.parametrize("kept", OURS)
def test_the_differences_are_those_of_the_kept_runs(kept: Path, tmp_path: Path) -> None:
    asked = ["compare", *_settings(kept), "columns=R -> A", f"base={OURS[kept]}", f"out={tmp_path}"]
    assert main(["report", *asked]) == 0
    name = _file("R -> A", "-compared")
    assert _rows(tmp_path / name) == _rows(kept / name)


def _figures(path: Path) -> list[list[str]]:
    """Without what a run cost, and its command."""
    keys = ("row", "column", "metric", "mean", "sem", "n", "seeds", "hash")
    return [[row[key] for key in keys] for row in _rows(path)]


def test_the_page_of_expected_accuracies_has_the_verdicts_of_the_kept_runs() -> None:
    """R -> A, nets with the statistics that were trained, without rounds and with them."""
    found: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for file in KEPT.rglob(METRICS):
        run = read_metrics(file.parent)
        assert run is not None
        on_real = run.final.n == 334 and run.source != run.target
        if not on_real or run.quality is None or run.quality.trust is None:
            continue
        if run.evaluation.norms == "trained" and run.final.accuracy is not None:
            found[bool(run.rounds)].append((run.final.accuracy, run.quality.trust.expected))
    (true, expected), (students, of_them) = (np.array(found[some]).T for some in (False, True))
    refused = expected < 0.5
    known = true[refused]
    (odd,), (thought,) = true[~refused], expected[~refused]
    assert (of_them < 0.5).all()
    said = (
        f"Of the {len(true)} without rounds and with the statistics that were trained "
        f"{len(known)} were refused, {(known < 0.5).sum()} of which are right about fewer than "
        f"half and {(known >= 0.5).sum()} about 50 to {100 * known.max():.0f} %; one was not "
        f"({100 * thought:.0f} % expected, {100 * odd:.0f} % true). The estimate is "
        f"{100 * np.abs(expected - true).mean():.1f} points off on average, at most "
        f"{100 * (expected - true).max():.1f} too high. Of {len(students)} students of rounds, all "
        f"refused, it is {100 * np.abs(of_them - students).mean():.1f} off"
    )
    assert said in " ".join((ROOT / "docs" / "results" / "trust.md").read_text("utf-8").split())
