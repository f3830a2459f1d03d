"""The page of results prints figures of the kept files next to it."""

import re

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
