"""`report keep`: a table is the same from what is kept as from the runs themselves."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from qs3.report.tables.comparison import against
from qs3.report.tables.formats import markdown
from qs3.report.tables.keeping import finished_runs, keep
from qs3.report.tables.running import missing
from qs3.report.tables.table import build_table
from qs3.runs.metrics import METRICS
from qs3.runs.predictions import FILE, read_predictions, write_predictions
from tests.report.tables.test_running import fill
from tests.running import main

PLACE = "target test"
ROWS = """
title: Two rows
metrics: [accuracy]
columns: [target test]
rows:
  - {name: source only, target test: {run: experiment=cad10 method=source_only}}
  - {name: DANN, target test: {run: experiment=cad10 method=dann}}
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "two.yaml").write_text(ROWS)
    return str(tmp_path / "two.yaml")


def test_kept_results_are_the_table_without_the_runs(file, tmp_path, capsys):
    logs, kept = tmp_path / "logs", tmp_path / "kept"
    table = fill(logs, file, {("source only", PLACE): 10, ("DANN", PLACE): 14})
    compared = against(table, "source only")
    for run in finished_runs(table):
        (run.folder / "model.ckpt").write_bytes(bytes(10**6))
    assert len(keep(table, kept)) == 6
    assert keep(table, kept) == []  # nothing is written twice
    assert sum(p.stat().st_size for p in kept.rglob("*.*") if p.is_file()) < 10**5
    shutil.rmtree(logs)
    again = build_table(file, logs, kept=kept)
    assert markdown(again) == markdown(table)
    assert missing(again, (0, 1, 2)) == []
    assert against(again, "source only") == compared
    assert compared[0].differences
    words = [f"table={file}", f"log_dir={logs}", f"kept={kept}", f"into={tmp_path / 'third'}"]
    assert main(["report", "keep", *words]) == 0
    assert "6 finished runs of table two, 6 new" in capsys.readouterr().out
    assert main(["report", "table", words[0], f"kept={tmp_path / 'nowhere'}"]) == 1
    assert "nowhere is not there; `qs3 report keep` makes" in capsys.readouterr().err
    for more, note in (
        ([], ""),
        (["overrides=data.points=64"], f"note: kept={kept}: none of its 6 runs is of a cell that"),
    ):
        assert main(["report", "table", *words[:3], *more]) == 0
        said = capsys.readouterr().err
        assert said.startswith(note)
        assert bool(said) == bool(note)


def test_a_table_that_takes_another_s_place_is_said(file, tmp_path, capsys):
    """Of two folders of kept runs; their tables have one name."""
    for name, row in (("a", "source only"), ("b", "DANN")):
        keep(fill(tmp_path / name, file, {(row, PLACE): 10}), tmp_path / f"kept_{name}")
    words = [f"table={file}", "log_dir=nowhere", f"out={tmp_path}"]

    def said(*more):
        assert main(["report", *more, *words]) == 0
        return capsys.readouterr().out.splitlines()[-1]

    replaced = " (replaced what was there; out=FOLDER would keep both)"
    saved = f"saved {tmp_path}/two.md, .csv, .tex"
    assert said("table", f"kept={tmp_path / 'kept_a'}") == saved
    assert said("table", f"kept={tmp_path / 'kept_a'}") == saved  # the same
    (tmp_path / "two.md").unlink()
    kept = f"kept={tmp_path / 'kept_b'}"
    assert said("table", kept) == saved + replaced
    saved = f"saved {tmp_path}/two-compared.md, .csv"
    assert said("compare", kept, "base=dann") == saved
    assert said("compare", kept, "base=source") == saved + replaced


def test_a_run_that_is_there_comes_before_a_kept_one(file, tmp_path):
    logs, kept = tmp_path / "logs", tmp_path / "kept"
    before = fill(tmp_path / "before", file, {("source only", PLACE): 10, ("DANN", PLACE): 14})
    keep(before, kept)
    now = fill(logs, file, {("DANN", PLACE): 18})
    for folder in kept.glob("*/seed*"):  # their log folder differs, and is not part of the name
        assert (tmp_path / "before" / folder.parent.name / folder.name).is_dir()
    both = {c.row: c.group for c in build_table(file, logs, kept=kept).cells}
    alone = {c.row: c.group for c in now.cells}
    assert both["DANN"] == alone["DANN"]
    assert [run.folder.parent.parent for run in both["source only"].finished] == [kept] * 3


def test_rounding_never_changes_a_prediction(file, tmp_path):
    run = finished_runs(fill(tmp_path / "logs", file, {("DANN", PLACE): 14}))[0]
    said = read_predictions(run.folder / FILE)
    close = np.full_like(said.probabilities, 0.49999)
    close[:, 1] = 0.50001
    write_predictions(run.folder / FILE, replace(said, probabilities=close))
    (into, *_) = keep(build_table(file, tmp_path / "logs"), tmp_path / "kept")
    assert (read_predictions(into / FILE).predicted == 1).all()


def test_what_an_older_version_kept_stays_as_it_wrote_it(file, tmp_path):
    table = fill(tmp_path / "logs", file, {("DANN", PLACE): 14})
    first, second, _ = keep(table, tmp_path / "kept")
    older = json.loads((first / METRICS).read_text())
    del older["quality"]["trust"]  # there was a version without this field
    (first / METRICS).write_text(before := json.dumps(older))
    whole = (second / METRICS).read_text()
    (second / METRICS).write_text("{}")
    assert keep(table, tmp_path / "kept") == [second]
    assert (first / METRICS).read_text() == before
    assert (second / METRICS).read_text() == whole
