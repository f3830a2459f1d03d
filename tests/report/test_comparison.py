"""Differences of rows and effects, by hand, from runs and from kept files."""

import pytest

from qs3.errors import ConfigError
from qs3.report.comparison import against, effects, text
from qs3.report.results import write_kept
from qs3.report.table import build_table, kept_lines
from qs3.runs.metrics import DataHashes, Evaluated
from qs3.runs.predictions import FILE, write_predictions
from tests.report.filled import PLACE, fill, predictions, run_cell
from tests.report.made_runs import scores

SMALL = f"""
title: Small
metrics: [accuracy]
columns: [{PLACE}]
rows:
  - {{name: source only, run: experiment=cad10 method=source_only}}
  - {{name: DANN, run: experiment=cad10 method=dann}}
  - {{name: PCM, run: experiment=cad10}}
  - {{name: GAST, run: experiment=cad10 method=gast}}
"""
BLOCKS = {
    "meshes": tuple(f"block{i // 5:04d}" for i in range(20)),
    "tiers": ("clean",) * 10 + ("hard",) * 10,
}


@pytest.fixture(autouse=True)
def small(tmp_path):
    (tmp_path / "small.yaml").write_text(SMALL)


def test_by_hand(tmp_path):
    table = fill(tmp_path, str(tmp_path / "small.yaml"), {"source only": 10, "DANN": 14, "PCM": 10})
    found = {one.name: one for one in against(table, "source only")}
    assert len(found) == len(table.rows) - 1
    dann, _ = found["DANN"].subsets["all"]
    assert (dann.mean, dann.seeds, dann.clusters) == (pytest.approx(0.2), 3, 20)
    assert found["PCM"].subsets["all"][0].mean == 0
    assert "not run" in found["GAST"].why
    shown = text(list(found.values()), "source only", table=table)
    assert shown.startswith(table.title)
    assert "SIMULATED target: kinectsim10" in shown.splitlines()
    assert "+20.0 [" in shown
    assert "intervals are narrow" in shown  # these predictions know no objects
    (less,) = (one for one in against(table, "DANN", reverse=True) if one.name == "source only")
    assert less.subsets["all"][0].mean == pytest.approx(0.2)
    for word in ("x", "a"):  # none, and several
        with pytest.raises(ConfigError):
            against(table, word)


def test_tiers_and_blocks_from_runs_and_from_a_kept_file(tmp_path):
    """Ten clean and ten hard clouds in four blocks of frames."""
    known = Evaluated(split="test", labels=True, norms="trained", tiers={"clean": scores(0.5)})
    rows = {"source only": 5, "DANN": 13}
    table = fill(
        tmp_path, str(tmp_path / "small.yaml"), rows, changes={"evaluation": known}, **BLOCKS
    )
    write_kept(tmp_path / "kept.csv.gz", kept_lines(table))
    kept = build_table(
        str(tmp_path / "small.yaml"), tmp_path / "none", kept=tmp_path / "kept.csv.gz"
    )
    for one in (table, kept):
        compared = against(one, "source only")
        (found,) = (one for one in compared if one.subsets)
        means = {name: pair[0].mean for name, pair in found.subsets.items()}
        assert means == pytest.approx({"all": 0.4, "clean": 0.5, "hard": 0.3})
        clusters = {name: pair[0].clusters for name, pair in found.subsets.items()}
        assert clusters == {"all": 4, "clean": 2, "hard": 2}
        assert "seeds and test blocks of frames (4)" in text(compared)
    assert text(against(table, "DANN")) == text(against(kept, "DANN"))


def test_what_cannot_be_compared(tmp_path):
    def why(**changes):
        table = build_table(str(tmp_path / "small.yaml"), tmp_path)
        (one,) = (one for one in against(table, "source only") if one.name == "DANN")
        assert not one.subsets
        return one.why

    table = fill(tmp_path, str(tmp_path / "small.yaml"), {"source only": 10})
    cells = {cell.row: cell for cell in table.cells}
    assert "not run" in why()
    (folder,) = run_cell(tmp_path, cells["DANN"], (0,))
    assert "fewer than two seeds" in why()
    folders = [folder, *run_cell(tmp_path, cells["DANN"], (1,))]
    assert "predictions.csv" in why()
    for folder in folders:
        other = tuple(map(str, range(20, 40)))
        write_predictions(folder / FILE, predictions(10, ids=other))
    assert "different clouds" in why()
    run_cell(tmp_path, cells["DANN"], (2,), data=DataHashes(source="a" * 64, target="c" * 64))
    assert "not averaged" in why()


def test_other_targets_are_not_compared(tmp_path):
    changes = {"data": DataHashes(source="a" * 64, target="c" * 64)}
    fill(tmp_path, str(tmp_path / "small.yaml"), {"source only": 10})
    table = fill(tmp_path, str(tmp_path / "small.yaml"), {"DANN": 12}, changes=changes)
    (one,) = (one for one in against(table, "source only") if one.name == "DANN")
    assert "different targets" in one.why


def test_effects_of_crossed_factors(tmp_path):
    lines = ["title: t", "metrics: [accuracy]", f"columns: [{PLACE}]", "rows:"]
    right = {}
    for i, (a, b) in enumerate((a, b) for a in "xy" for b in "uv"):
        run = f"experiment=cad10 selftraining=qbst selftraining.theta=0.{i + 1}"
        lines.append(f"  - {{name: {a}{b}, factors: {{A: {a}, B: {b}}}, run: {run}}}")
        right[a + b] = (10, 12, 14, 18)[i]
    lines.append("  - {name: plain, run: experiment=cad10}")
    (tmp_path / "own.yaml").write_text("\n".join(lines))
    found = {one.name: one for one in effects(fill(tmp_path, str(tmp_path / "own.yaml"), right))}
    means = {name: one.subsets["all"][0].mean for name, one in found.items()}
    assert means == pytest.approx(
        {"A: y minus x, over u; v": 5 / 20, "B: v minus u, over x; y": 3 / 20}
    )
