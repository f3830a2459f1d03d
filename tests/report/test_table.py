"""Tables' files, and what is printed of made-up runs."""

import csv
import io
import subprocess
import sys
from dataclasses import replace

import pytest

from qs3.config.compose import choices
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.report.formats import TO_RUN, csv_text, grid, markdown, to_run
from qs3.report.table import build_table
from qs3.runs.metrics import DataHashes, DataMadeOf, EpochScores, Evaluated, Warmup
from tests.report.filled import run_cell
from tests.report.made_runs import CATALOGUE, scores
from tests.running import ROOT, main

OWN = """
title: Own
metrics: [accuracy]
columns:
  R → N: domain@data.source=rooms10 domain@data.target=nyuv2
  S → K: domain@data.source=specklenet10 domain@data.target=kinectsim10
  PointDA-10: null
rows:
  - {name: source only, run: experiment=source_only_s2d, seeds: 5, paper: [50.0, [40.0, 1.5], 62.2]}
  - {name: PCFEA, PointDA-10: {paper: 76.5, selected: target test accuracy, source: site}}
  - {name: one, run: experiment=source_only_s2d seed=5, columns: [S → K]}
sources: {site: read in a project page}
"""


@pytest.fixture
def own(tmp_path):
    """Builds a table of one's own from its file's text, with the runs of a folder."""

    def built(text=OWN, **given):
        (tmp_path / "own.yaml").write_text(text)
        return build_table(str(tmp_path / "own.yaml"), tmp_path / "logs", **given)

    return built


@pytest.mark.slow
@pytest.mark.parametrize("name", choices("table"))
def test_every_cell_composes_and_cells_differ(name, tmp_path):
    table = build_table(name, tmp_path)
    cells = [cell for cell in table.cells if cell.overrides]
    assert all(cell.target for cell in cells)
    assert len({(c.column, c.overrides, c.entry.take) for c in cells}) == len(cells)


def test_the_paper_s_numbers(tmp_path):
    paper = {
        (c.row, c.column): c.entry.published for c in build_table("uda", tmp_path, runs=False).cells
    }
    assert paper["PCM + QBST (from S it is QS3)", "S → D"] == "72.4 ± 0.8"
    assert paper["DGCNN (w/o adapt)", "M → D"] == "46.7 ± 1.4"


def test_entries(own):
    table = own()
    real, simulated, published = table.rows["source only"]
    assert (real.target, simulated.target, simulated.simulated) == ("nyuv2", "kinectsim10", True)
    assert simulated.entry.published == "40.0 ± 1.5"
    assert simulated.seeds == (0, 1, 2, 3, 4)
    assert not published.overrides
    pcfea = table.rows["PCFEA"][2].entry
    assert (pcfea.published, pcfea.selected) == ("76.5", "target test accuracy")
    assert pcfea.source == "read in a project page"
    assert not table.rows["one"][0].overrides
    one = own(columns=["s->k"], runs=False).rows["one"]
    assert [c.column for c in one if c.overrides] == ["S → K"]
    extra = ["report.pictures=false", "S->K:data.points=64"]
    for cell in own(extra=extra, runs=False).rows["source only"][:2]:
        assert ("data.points=64" in cell.overrides) == (cell.column == "S → K")
        assert "report.pictures=false" in cell.overrides


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("title: Own", "title: ["),
        ("metrics: [accuracy]", "metrics: [acuracy]"),
        ("paper: 76.5", "paper: 176.5"),
        ("seeds: 5", "seeds: 0"),
        (", 62.2]", "]"),  # a number for each column is needed
        ("columns: [S → K]", "columns: [S → L]"),
        ("name: one", "name: PCFEA"),
        ("experiment=source_only_s2d seed=5", "experiment=source_only_s2d no_such_key=1"),
    ],
)
def test_wrong_files(own, old, new):
    assert old in OWN
    with pytest.raises((ConfigError, DataError)):
        own(OWN.replace(old, new))


def test_what_is_asked_wrongly(own, tmp_path):
    for given in (
        {"columns": ["mars"]}, {"target": "mars"}, {"extra": ["mars:data.points=64"]},
    ):  # fmt: skip
        with pytest.raises(ConfigError):
            own(**given)
    with pytest.raises(MissingDataError, match="no_such_table"):
        build_table("no_such_table", tmp_path)


def test_quickstart(tmp_path):
    empty = build_table("quickstart", tmp_path)
    # PCM is the warm-up of QS3: one command fills both rows.
    assert markdown(empty).count("python train.py experiment=quickstart") == 4
    for cell in (*empty.cells[:2], empty.cells[4]):
        run_cell(tmp_path, cell)
    selected = EpochScores(epoch=7, scores=scores(0.52))
    warmup = Warmup(selected=selected, last=selected)
    run_cell(tmp_path, empty.cells[3], seeds=(0,), accuracy=0.7, warmup=warmup)
    table = build_table("quickstart", tmp_path)
    assert grid(table)[1:] == [
        ["source only, surface samples (M)", "51.0 ± 0.6", "41.0 ± 0.6"],
        ["source only, speckle scans (S)", "51.0 ± 0.6", "41.0 ± 0.6"],
        ["PCM, speckle scans", "52.0 (n=1)", "42.0 (n=1)"],
        ["QS3 = PCM + QBST as released, speckle scans", "70.0 (n=1)", "60.0 (n=1)"],
        ["PCM + QBST beside the source (ours)", "51.0 ± 0.6", "41.0 ± 0.6"],
    ]
    text = markdown(table)
    assert "- SIMULATED target: kinectsim10\n" in text
    assert "majority rate of kinectsim10: 45.0 %" in text
    assert "teacher selected by source_val; student selected by last" in text
    assert to_run(table) == [table.cells[3].command]
    run_cell(tmp_path, empty.cells[3], seeds=(1, 2), accuracy=0.7, warmup=warmup)
    assert TO_RUN not in markdown(build_table("quickstart", tmp_path))


def test_published_numbers_stand_above_ours(own, tmp_path):
    real, simulated, _ = own().rows["source only"]
    run_cell(tmp_path / "logs", real, target="nyuv2", simulated=False)
    head, published, ours, pcfea, _ = grid(own())
    assert head[1] == "R → N, accuracy %"
    assert published == ["source only, published", "50.0", "40.0 ± 1.5", "62.2"]
    assert ours == ["source only", "51.0 ± 0.6", "not run", ""]
    assert pcfea[::3] == ["PCFEA, published (epoch by target test accuracy)", "76.5"]
    first = next(csv.DictReader(io.StringIO(csv_text(own()))))
    assert float(first["mean"]) == pytest.approx(51)
    assert (first["paper"], first["seeds"]) == ("50.0", "0 1 2")
    assert first["command"].startswith("python train.py experiment=source_only_s2d")
    run_cell(tmp_path / "logs", simulated)  # not on the published data
    table = own()
    assert grid(table)[2][2] == "51.0 ± 0.6 ‡"
    assert grid(table)[0][2] == "S → K (simulated), accuracy %"
    assert "- ‡ not the data of the published figures" in markdown(table)


def test_averages(own, tmp_path):
    text = OWN.replace("title", "averages: true\ntitle").replace("  PointDA-10: null\n", "")
    text = text.replace(", 62.2]", "], average: 45.1").partition("  - {name: PCFEA")[0]
    for cell in own(text).cells:
        run_cell(tmp_path / "logs", cell)
    _, published, ours = grid(own(text))
    assert published == ["source only, published", "50.0", "40.0 ± 1.5", "45.1"]
    assert ours[-1] == "51.0 ± 0.6 ‡"


def test_sources_of_other_meshes_are_named(tmp_path):
    first, second, *_ = build_table("quickstart", tmp_path).cells
    for cell, meshes in ((first, "a" * 12), (second, "c" * 12)):
        made = DataMadeOf(source=replace(CATALOGUE, meshes=meshes), target=CATALOGUE)
        run_cell(tmp_path, cell, made_of=made)
        table = build_table("quickstart", tmp_path)
        named = "target test: sources were generated from different meshes" in markdown(table)
        assert named == (cell is second)


def test_numbers_that_are_not_there(tmp_path):
    """A warm-up has no scores of tiers; a target without tiers never gets any by another run."""
    path = tmp_path / "x.yaml"
    path.write_text(
        "title: x\nmetrics: [accuracy_clean, accuracy]\ncolumns: [T]\nrows:\n"
        "- {name: QS3, run: experiment=quickstart}\n"
        "- {name: PCM, run: experiment=quickstart, take: warmup}\n"
    )
    known = Evaluated(split="test", labels=True, norms="trained", tiers={"clean": scores(0.7)})
    for name, changes, shown in (
        ("a", {"evaluation": known}, ["70.0 ± 0.0", "51.0 ± 0.6", "-", "50.0 ± 0.0"]),
        ("b", {}, ["-", "51.0 ± 0.6", "-", "50.0 ± 0.0"]),
        ("c", {"accuracy": None}, ["no target labels"] * 2 + ["-", "50.0 ± 0.0"]),
    ):
        run_cell(tmp_path / name, build_table(str(path), tmp_path / name).cells[0], **changes)
        table = build_table(str(path), tmp_path / name)
        assert [cell.text(m) for cell in table.cells for m in table.spec.metrics] == shown
        assert to_run(table) == []


def test_problems_reach_the_reader(tmp_path):
    cell = build_table("quickstart", tmp_path).cells[0]
    run_cell(tmp_path, cell, seeds=(0, 1))
    run_cell(tmp_path, cell, seeds=(2,), data=DataHashes(source="x", target="y"))
    text = markdown(build_table("quickstart", tmp_path))
    assert "| not averaged † " in text
    assert "the source dataset differs" in text


def test_another_target(own):
    rows = (
        ("pcm", "paper: [72.4], run: experiment=qs3_s2d selftraining=none"),
        ("upper", "run: experiment=source_only_s2d method=supervised"),
    )
    lines = [f"- {{name: {name}, {rest}}}" for name, rest in rows]
    text = "\n".join(["title: x", "metrics: [accuracy]", "columns: [S → D]", "rows:", *lines])
    table = own(text, target="kinectsim10")
    assert all("domain@data.target=kinectsim10" in c.overrides for c in table.cells)
    assert not any(c.entry.published for c in table.cells)
    assert "on another target: kinectsim10" in markdown(table)
    # the upper bound is trained on the other target, too
    sources = ["domain@data.source=kinectsim10" in c.overrides for c in table.cells]
    assert sources == [False, True]
    assert table.columns == ("S → kinectsim10",)


def test_the_command(tmp_path, capsys):
    words = ["report", "table=quickstart", f"log_dir={tmp_path}", f"data_dir={tmp_path}/data"]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert all(printed.count(f"\n{name}") == 1 for name in build_table("quickstart", tmp_path).rows)
    text = (tmp_path / "tables" / "quickstart.md").read_text()
    assert f"paths.data_dir={tmp_path}/data paths.log_dir={tmp_path}" in text
    assert {p.suffix for p in (tmp_path / "tables").iterdir()} == {".md", ".csv"}
    assert main(["report", "tabel=quickstart"]) == 1
    assert main(["report", "keep", *words[1:], f"into={tmp_path}/x.csv.gz"]) == 1  # no runs


def test_the_report_imports_no_torch(tmp_path):
    code = (
        "import sys; from tests.running import main\n"
        "main(['report', 'table=quickstart', *sys.argv[1:]]); sys.exit('torch' in sys.modules)"
    )
    argv = [sys.executable, "-c", code, f"log_dir={tmp_path}"]
    subprocess.run(argv, check=True, capture_output=True, cwd=ROOT)
