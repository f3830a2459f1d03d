"""The page of results prints figures of the kept files next to it."""

import re

import pandas as pd
import pytest

from qs3.report.comparison import against
from qs3.report.table import build_table
from tests.running import ROOT

RESULTS = ROOT / "docs" / "results"
PAGE = RESULTS / "index.md"
TABLES = [
    ("cad10", "cad10", None),
    ("real", "real", "objects"),
    ("leaderboard", "leaderboard", None),
    ("leaderboard", "leaderboard_second", None),
    ("leaderboard", "leaderboard_third", None),
]


@pytest.mark.parametrize(("table", "kept", "target"), TABLES)
def test_means_stand_on_the_page(table, kept, target, tmp_path):
    """Every accuracy of several seeds, with its standard error."""
    built = build_table(table, tmp_path, (), target, RESULTS / f"{kept}.csv.gz")
    text = PAGE.read_text("utf-8")
    cells = [
        c for c in built.cells if c.runs.seeds and c.column not in ("S → K", "S → C", "R → A0")
    ]
    assert cells
    for cell in cells:
        stat = cell.runs.stat("accuracy")
        shown = stat.percent() if stat.sem is not None else f"{100 * stat.mean:.1f}"
        assert shown in text, cell.row


def test_differences_stand_on_the_page(tmp_path):
    ours = "alpha-BN and estimated shares, batches of 32 (ours)"
    kept = RESULTS / "leaderboard_second.csv.gz"
    built = build_table("leaderboard", tmp_path, kept=kept, columns=["R -> A"])
    text = PAGE.read_text("utf-8")
    found = [one for one in against(built, ours, reverse=True) if one.subsets]
    assert len(found) == 5
    for one in found:
        for d in one.subsets["all"]:
            mean, low, high = (f"{100 * value:.1f}" for value in (d.mean, d.low, d.high))
            assert re.search(rf"\+?{re.escape(mean)} \[{low}, {high}\]", text), one.name


def test_means_over_folds_stand_on_the_page_about_own_scans(tmp_path):
    built = build_table("own_scans", tmp_path, kept=RESULTS / "own_scans.csv.gz")
    text = (ROOT / "docs" / "how-to" / "adapt.md").read_text("utf-8")
    for cells in built.rows.values():
        lines = pd.concat([cell.runs.finished for cell in cells])
        assert len(lines) in (5, 15)
        seeds = [f"{100 * of.accuracy.mean():.1f}" for _, of in lines.groupby("seed")]
        means = [f"{100 * lines[name].mean():.1f}" for name in ("accuracy", "balanced_accuracy")]
        shown = ", ".join(seeds) if len(seeds) > 1 else ""
        assert f"| {means[0]} | {shown} | {means[1]} |".replace("|  |", "| |") in text
