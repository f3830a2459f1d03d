"""What the data are made of stands beside every figure: of a real run, and in tables."""

import json
import logging
import shlex
from dataclasses import replace

import pytest
import yaml

from qs3.report.judge.judging import _families
from qs3.report.run_files import read_run
from qs3.report.run_page import key_figures
from qs3.report.tables.aggregate import summarise
from qs3.report.tables.comparison import effects, text
from qs3.report.tables.formats import csv_text, grid, latex, markdown
from qs3.report.tables.table import build_table
from qs3.runs.metrics import DataMadeOf, read_metrics
from qs3.training.command import headline, train
from tests.report.made_runs import CATALOGUE, PUBLISHED, change
from tests.report.tables.test_tables import run_cell
from tests.training.toy import overrides, toy_config

SOURCE = "embedded catalogue, speckle_stereo, 5 views"
TARGET = "embedded catalogue, kinect_like, 4 views, kinectsim10 v2"


@pytest.fixture
def table(finished, toy_data, tmp_path):
    """The real run as the one cell of a table, beside a figure that was published."""
    line = shlex.join(overrides(finished.parents[2], f"paths.data_dir={toy_data}"))
    cell = {"run": line, "paper": [72.4, 0.8]}
    spec = {"title": "T", "metrics": ["accuracy"], "columns": ["c"], "rows": [{"name": "r"}]}
    spec["rows"][0]["c"] = cell
    (tmp_path / "t.yaml").write_text(yaml.safe_dump(spec))

    def build():
        found = build_table(str(tmp_path / "t.yaml"), finished.parents[2] / "logs")
        assert len(found.cells[0].group.results) == 1
        return found

    return build


def test_a_real_run_says_it_everywhere(finished, toy_data, table, caplog):
    made = json.loads((finished / "metrics.json").read_text())["made_of"]
    assert made["source"]["objects"] == "embedded catalogue"
    assert made["target"]["benchmark"] == "kinectsim10 v2"
    both = f"specklenet10 ({SOURCE}), kinectsim10 ({TARGET})"
    assert f"; data: {both}; " in headline(read_metrics(finished))
    with caplog.at_level(logging.INFO):  # and again where it is found finished
        train(toy_config(finished.parents[2], f"paths.data_dir={toy_data}"))
    assert both in caplog.text
    figures = key_figures(read_run(finished))
    assert figures["source"] == f"specklenet10, made of: {SOURCE}"
    assert figures["target"] == f"kinectsim10 (simulated), made of: {TARGET}"
    said = summarise([finished])
    assert said.endswith(f"\ndata: specklenet10: {SOURCE}\ndata: kinectsim10: {TARGET}")
    for write in (markdown, latex, csv_text):
        assert SOURCE in write(table())
        assert TARGET in write(table())


def test_the_judge_says_it(finished):
    (known,) = _families([finished / "result.pt"])
    assert known.data == f"specklenet10 ({SOURCE}), kinectsim10 ({TARGET})"


def test_beside_published_figures_other_data_are_marked(table):
    assert grid(table())[1][1].endswith("(n=1) ‡")
    mark = "not the data of the published figures, so not to be compared with them: "
    assert f"- ‡ {mark}specklenet10 ({SOURCE}); kinectsim10 ({TARGET})\n" in markdown(table())
    rows = [line for line in latex(table()).splitlines() if not line.startswith("%")]
    assert any(mark in line for line in rows)  # in the tabular, not only in a comment
    assert r"(n=1) $\ddagger$" in latex(table())


def test_published_data_are_not_marked(table, finished):
    before = (finished / "metrics.json").read_bytes()
    try:
        change(finished, made_of=DataMadeOf(source=PUBLISHED, target=PUBLISHED))
        assert grid(table())[1][1].endswith("(n=1)")
        assert "‡" not in markdown(table())
        assert "- data: specklenet10: published files\n" in markdown(table())
    finally:
        (finished / "metrics.json").write_bytes(before)


def sources(tmp_path, **meshes):
    """A table of two columns, with a run in each on a source from meshes of these digits."""
    runs = {"M → D": "source_only_m2d", "S → D": "source_only_s2d"}
    row = {"name": "r", **{column: {"run": f"experiment={run}"} for column, run in runs.items()}}
    spec = {"title": "T", "metrics": ["accuracy"], "columns": list(runs), "rows": [row]}
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(spec))
    path = str(tmp_path / "two.yaml")
    for cell in build_table(path, tmp_path).cells:
        made = replace(CATALOGUE, meshes=meshes[cell.column[0]])
        known = {"source": f"domain_{cell.column[0]}", "simulated": False}
        run_cell(tmp_path, cell, **known, made_of=DataMadeOf(source=made, target=PUBLISHED))
    return build_table(path, tmp_path)


def test_sources_of_different_meshes_are_named(tmp_path):
    table = sources(tmp_path, M="aaa", S="bbb")
    line = (
        "the sources are made from different meshes: domain_M (embedded catalogue, kinect_like, "
        "4 views; meshes aaa) in M → D; domain_S (embedded catalogue, kinect_like, 4 views; "
        "meshes bbb) in S → D"
    )
    assert f"- {line}\n" in markdown(table)
    assert line in text(effects(table), table=table)
    assert "made from different meshes" in latex(table).split("bottomrule")[1]
    assert "‡" not in markdown(table)  # no published figure stands beside it


@pytest.mark.parametrize("meshes", [{"M": "aaa", "S": "aaa"}, {"M": "", "S": "bbb"}])
def test_sources_of_the_same_meshes_or_of_unknown_ones_are_not(tmp_path, meshes):
    assert "different meshes" not in markdown(sources(tmp_path, **meshes))


def test_rows_are_named_where_there_is_one_column(tmp_path):
    empty = build_table("quickstart", tmp_path)
    for cell, digits in ((empty.cells[0], "aaa"), (empty.cells[1], "bbb")):
        made = DataMadeOf(source=replace(CATALOGUE, meshes=digits), target=CATALOGUE)
        run_cell(tmp_path, cell, made_of=made)
    said = markdown(build_table("quickstart", tmp_path))
    assert "; meshes aaa) in source only, surface samples (M); " in said
    assert "; meshes bbb) in source only, speckle scans (S)\n" in said
    assert "‡" not in said  # nothing published stands beside it
