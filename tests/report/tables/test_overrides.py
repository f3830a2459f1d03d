"""Overrides that are for some columns of a table alone."""

from __future__ import annotations

import pytest

from qs3.errors import ConfigError
from qs3.report.tables.overrides import by_column, chosen, file_name, row_of, unknown
from qs3.report.tables.running import missing
from qs3.report.tables.table import build_table
from tests.running import main

COLUMNS = ("R → A", "R → A0", "S → K")
TABLE = """
title: Several targets
metrics: [accuracy]
columns:
  R → A: domain@data.source=roomscan10 domain@data.target=objects
  R → A0:
    run: domain@data.source=roomscan10 domain@data.target=objects data.target.published.fold=0
    seeds: 1
  S → K: domain@data.source=specklenet10 domain@data.target=kinectsim10
rows:
  - {name: source only, run: experiment=leaderboard, seeds: 5}
"""


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("a.b=1", [("a.b=1",)] * 3),
        ("R->A:a.b=1", [("a.b=1",), (), ()]),
        ("r -> a:a.b=1", [("a.b=1",), (), ()]),
        ("R → A,S->K:+a=1", [("+a=1",), (), ("+a=1",)]),
        ("A:a=1", [("a=1",), ("a=1",), ()]),  # of no column: all with it in their name
        ("K:~a.b", [(), (), ("~a.b",)]),
        ("a.b={c: 1}", [("a.b={c: 1}",)] * 3),
        ("paths.data_dir=C:x", [("paths.data_dir=C:x",)] * 3),
    ],
)
def test_whose_they_are(word, expected):
    assert list(by_column([word], COLUMNS).values()) == expected
    own = by_column(["x=0", word, "x=1"], COLUMNS)
    assert [own[c] for c in COLUMNS] == [("x=0", *e, "x=1") for e in expected]


def test_a_column_that_is_not_there_is_named():
    with pytest.raises(ConfigError, match=r"M->D:a=1: no column has 'M->D' in its name; columns"):
        by_column(["M->D:a=1"], COLUMNS)

    with pytest.raises(ConfigError, match=r"S->K,M->D:a=1: no column has 'M->D' in its name"):
        by_column(["S->K,M->D:a=1"], COLUMNS)


def test_a_name_with_commas_is_one_name():
    """`rows=` and `columns=` are lists between commas, and rows are called such things."""
    names = ("source only", "source only, batches of 32", "AdaBN, batches of 32")
    assert chosen(names, ["source only", "batches of 32"]) == {"source only, batches of 32"}
    assert chosen(names, ["AdaBN", "source only"]) == {names[0], names[2]}
    assert unknown(names, ["batches", "mars", "source only", "batches of 32"]) == ["mars"]


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("seed=0,1", r"overrides: seed=0,1: each cell has several; .*, seeds=0,1 says"),
        ("S->K:+seed=3", r"overrides: S->K:\+seed=3: each cell has several"),
        ("paths.log_dir=/x", r"overrides: paths.log_dir=/x: the table .*; log_dir=FOLDER says"),
    ],
)
def test_what_a_table_says_itself_is_no_override(word, message, tmp_path):
    """Commands of the page ended in `seed=3 seed=0,1,2`; runs went where no table looked."""
    path = tmp_path / "several.yaml"
    path.write_text(TABLE)
    with pytest.raises(ConfigError, match=message):
        build_table(str(path), tmp_path, ["data.points=64", word], runs=False)


def test_the_row_that_a_word_means():
    rows = ("source only", "source only, batches of 32", "AdaBN, batches of 32", "PCM")
    assert row_of(rows, "source only", "t") == "source only"
    assert row_of(rows, "pcm", "t") == "PCM"
    assert row_of(rows, "ada", "t") == "AdaBN, batches of 32"
    with pytest.raises(ConfigError, match=r"against which row.*; rows are 'source only', 'so"):
        row_of(rows, "", "t")
    with pytest.raises(ConfigError, match=r"several rows of table t: 'source only, .*'AdaBN"):
        row_of(rows, "of 32", "t")
    with pytest.raises(ConfigError, match=r"t has no row 'PMC' \(did you mean 'PCM'\?\); rows are"):
        row_of(rows, "PMC", "t")


def test_other_runs_have_other_files():
    def name(overrides, columns=("S -> K",)):
        return file_name("table", None, columns=columns, overrides=overrides)

    quiet = "report.pictures=false S->K:data.target.published.file='/x y' paths.data_dir=/a"
    assert name("") == name(quiet) == "table-S-K"
    assert name("trainer=gpu") == "table-S-K-trainer=gpu"
    assert name("DGCNN:trainer=gpu +a.b=[1,2]", ()) == "table-DGCNN-trainer=gpu-a.b=-1-2"
    long = [f"data.points={i} model.dropout=0.12345 protocol.optimizer.lr=0.00{i}" for i in (1, 2)]
    assert len({*map(name, long)}) == 2
    assert all(len(name(f"{one} {one}")) < 30 for one in long)


def test_spaces_and_arrows_do_not_count():
    assert chosen(COLUMNS, ["r->a"]) == {"R → A"}
    assert chosen(COLUMNS, ["s -> k", "R→A0"]) == {"S → K", "R → A0"}


def test_a_key_that_one_column_s_target_lacks(tmp_path, capsys):
    """The archive's path, which the simulated target knows nothing of."""
    path = tmp_path / "several.yaml"
    path.write_text(TABLE)
    own = "data.target.published.file=/x/a.npz"
    with pytest.raises(ConfigError, match=r"'S → K': .*; for some columns alone: overrides="):
        build_table(str(path), tmp_path, [own])
    table = build_table(str(path), tmp_path, [f"R->A,R->A0:{own}", "data.points=64"])
    (real, fold, simulated) = table.rows["source only"]
    assert own in real.overrides
    assert own in fold.overrides
    assert own not in simulated.overrides
    assert all("data.points=64" in cell.overrides for cell in (real, fold, simulated))
    seeds = [[job.name[-1] for job in missing(table, columns=[c])] for c in table.columns]
    assert seeds == [list("01234"), ["0"], list("01234")]
    words = [f"table={path}", f"log_dir={tmp_path}", "overrides=M->D:a=1"]
    assert main(["report", *words]) == 1
    assert "M->D:a=1: no column has 'M->D' in its name" in capsys.readouterr().err
    assert main(["report", *words[:2], "columns=S -> K"]) == 0
    shown = capsys.readouterr().out
    assert "kinectsim10" in shown
    assert "domain@data.target=objects" not in shown
    assert (tmp_path / "tables/several-S-K.csv").is_file()
    assert main(["report", *words[:2], "columns=mars"]) == 1
    said = capsys.readouterr().err
    assert "no column of table several has 'mars' in its name; columns are 'R → A'" in said
    assert not (tmp_path / "tables/several-mars.csv").exists()


@pytest.mark.parametrize("seeds", ["0", "1.5", "[0]"])
def test_a_column_s_seeds_are_a_number(tmp_path, seeds):
    path = tmp_path / "x.yaml"
    path.write_text(TABLE.replace("seeds: 1", f"seeds: {seeds}"))
    with pytest.raises(ConfigError, match=r"x\.yaml: columns.*seeds"):
        build_table(str(path))


@pytest.mark.parametrize("seeds", ["0", "-1", "1.5", "true", "[0, 1]"])
def test_a_row_wants_a_seed_at_least(tmp_path, seeds):
    """Of none nothing would be trained, and the command would end in `seed= -m`."""
    path = tmp_path / "x.yaml"
    path.write_text(TABLE + f"  - {{name: none, run: experiment=leaderboard, seeds: {seeds}}}\n")
    with pytest.raises(ConfigError, match="row 'none': seeds: is how many"):
        build_table(str(path), runs=False)


NETS = """
title: Nets
metrics: [accuracy]
columns: ["S → D, DGCNN", "S → D (PointNet)", "M → D*"]
rows:
  - name: source only
    "S → D, DGCNN": {run: experiment=source_only_s2d}
    "S → D (PointNet)": {run: experiment=source_only_s2d model=pointnet}
    "M → D*": {run: experiment=source_only_m2d}
"""


def test_columns_of_another_target_are_still_told_apart(tmp_path):
    """Of two that were called alike the second's numbers stood in both."""
    path = tmp_path / "nets.yaml"
    path.write_text(NETS)
    table = build_table(str(path), target="kinectsim10", runs=False)
    assert table.columns == (
        "S → kinectsim10, DGCNN",
        "S → kinectsim10 (PointNet)",
        "M → kinectsim10",
    )
    runs = ["source_only_s2d", "source_only_s2d model=pointnet", "source_only_m2d"]
    more = "domain@data.target=kinectsim10"
    cells = table.rows["source only"]
    assert [" ".join(cell.overrides) for cell in cells] == [f"experiment={x} {more}" for x in runs]
    path.write_text(NETS.replace("M → D*", "S → B, DGCNN"))
    assert build_table(str(path), runs=False).columns[2] == "S → B, DGCNN"
    with pytest.raises(ConfigError, match="two columns are called 'S → kinectsim10, DGCNN'"):
        build_table(str(path), target="kinectsim10", runs=False)
