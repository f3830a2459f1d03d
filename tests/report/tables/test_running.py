"""`report run` fills a table with real trainings, `report compare` says how rows differ."""

from __future__ import annotations

import csv
import io
import os
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import ConfigError
from qs3.report.tables.cells import Table
from qs3.report.tables.comparison import against, csv_text, effects, text
from qs3.report.tables.overrides import chosen
from qs3.report.tables.running import Job, launch, missing
from qs3.report.tables.table import build_table
from qs3.runs.metrics import DataHashes, DataMadeOf, Evaluated
from qs3.runs.predictions import FILE, Predictions, read_predictions, write_predictions
from tests.report.made_runs import CATALOGUE, change, scores
from tests.report.tables.test_tables import run_cell
from tests.running import main
from tests.training.toy import overrides, write_toy

ROOT = Path(__file__).parents[3]


def jobs_of(tmp_path, *rows, seeds=(0, 1, 2)):
    return missing(build_table("cad10", tmp_path), seeds, rows)


def test_only_what_is_missing_is_run(tmp_path):
    table = build_table("cad10", tmp_path)
    cells = {cell.row: cell for cell in table.cells}
    run_cell(tmp_path, cells["DANN"], seeds=(0, 2))
    assert [job.name for job in jobs_of(tmp_path, "dann")] == ["DANN, seed 1"]
    assert [job.name for job in jobs_of(tmp_path, "adabn", "dann", seeds=(0,))] == ["AdaBN, seed 0"]
    everything = jobs_of(tmp_path)
    assert len(everything) == 3 * len(table.rows) - 2
    assert everything[0].command.startswith("python train.py experiment=cad10 ")


def test_runs_that_cells_share_are_run_once(tmp_path):
    """factorial's last row is one run in two columns."""
    table = build_table("factorial", tmp_path)
    jobs = missing(table, [0])
    assert len(jobs) == len(table.cells) - 1
    assert len({job.overrides for job in jobs}) == len(jobs)


def test_long_runs_begin_first(tmp_path):
    table = build_table("quickstart", tmp_path)
    names = [job.name for job in missing(table, [0, 1])]
    assert names[:2] == [f"QS3 = PCM + QBST, speckle scans, seed {seed}" for seed in (0, 1)]
    assert names[2].startswith("source only, surface samples")
    assert len(names) == 6  # PCM's row shows a part of QS3's runs


def test_one_cell(tmp_path):
    table = build_table("factorial", tmp_path)
    every = missing(table, [0])
    row, column = next((c.row, c.column) for c in table.cells if c.runnable)
    (job,) = missing(table, [0], [row], [column])
    assert job.name == f"{row}, {column}, seed 0"
    assert len(missing(table, [0], columns=[column])) < len(every)
    cells = [cell for cell in build_table("self_training", tmp_path).cells if cell.runnable]
    wanted = chosen((cell.column for cell in cells), ["s -> d"])
    assert len([cell for cell in cells if cell.column in wanted]) == len(cells) / 2
    names = ["PCM", "DefRec+PCM", "DANN", "PCM + QBST"]
    assert chosen(names, ["pcm"]) == {"PCM"}  # the row of that name, not all that contain it
    assert chosen(names, ["qbst", "dann"]) == {"PCM + QBST", "DANN"}
    assert chosen(names, ["rec+p"]) == {"DefRec+PCM"}
    assert chosen(names, []) == set(names)
    with pytest.raises(ConfigError, match=r"no column of table .* has 'x' in its name; columns to"):
        missing(table, [0], columns=["x"])
    with pytest.raises(ConfigError, match=r"no row of table .* has 'mars' in its name; rows to"):
        missing(table, [0], rows=[row, "mars"])  # not: the others, without a word


def test_a_name_means_its_own_row_alone(tmp_path):
    """Not one that is written otherwise, and, if it cannot be run, none that holds the word."""
    names = ["DANN", "dann", "GAST"]
    assert chosen(names, ["dann"]) == {"dann"}
    assert chosen(names, ["Dann"]) == {"DANN", "dann"}
    path = tmp_path / "own.yaml"
    path.write_text(
        "title: Own\nmetrics: [accuracy]\ncolumns: [T]\nrows:\n"
        "  - {name: GAST, paper: [70]}\n"
        "  - {name: GAST + SPST, T: {run: experiment=qs3_s2d}}\n"
    )
    table = build_table(str(path), tmp_path)
    assert [job.name for job in missing(table, [0], ["spst"])] == ["GAST + SPST, seed 0"]
    with pytest.raises(ConfigError, match="no row 'GAST' of table own can be run; rows to run are"):
        missing(table, [0], ["GAST"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["launcher=dask"], "launcher=dask; set launcher=basic|joblib|"),
        (["+hydra.launcher.a.b=1"], "+hydra.launcher.a.b=1 needs a launcher; set"),
        (["hydra.launcher.partition=gpu"], "partition=gpu needs a launcher; set"),
        (["jobs=0", "launcher=joblib"], "jobs must be a whole number of at least 1"),
    ],
)  # fmt: skip
def test_what_is_refused(words, message, tmp_path, capsys):
    assert main(["report", "train", "table=cad10", f"log_dir={tmp_path}", *words]) == 1
    assert message in capsys.readouterr().err


def test_a_failure_is_the_exit_status(tmp_path, capfd):
    (job,) = jobs_of(tmp_path, "dann", seeds=(0,))
    bad = Job("bad", (*job.overrides, "num_classes=1"))
    assert launch([bad], "basic", 1, str(tmp_path)) == 1
    assert "1 of 1 jobs failed:\n  ConfigError: num_classes" in capfd.readouterr().out


def fill(log_dir: Path, name: str, right_of: dict[tuple[str, str], int]) -> Table:
    """A table whose runs are right about so many of 20 clouds, the same for all seeds."""
    cells = {(cell.row, cell.column): cell for cell in build_table(name, log_dir).cells}
    for place in right_of:
        run_cell(log_dir, cells[place])
    for cell in build_table(name, log_dir).cells:
        if (cell.row, cell.column) not in right_of:
            continue
        assert cell.group is not None
        predicted = (np.arange(20) >= right_of[cell.row, cell.column]).astype(int)
        names, labels = tuple(map(str, range(20))), np.zeros(20, dtype=int)
        said = Predictions(("a", "b"), names, names, labels, np.eye(2)[predicted])
        for run in cell.group.finished:
            write_predictions(run.folder / FILE, said)
    return build_table(name, log_dir)


def test_compare_by_hand(tmp_path):
    rows = {"source only": 10, "DANN": 14, "PCM": 10}
    table = fill(tmp_path, "cad10", {(row, "target test"): n for row, n in rows.items()})
    found = {one.name: one for one in against(table, "source only")}
    assert len(found) == len(table.rows) - 1
    dann, pcm = found["DANN"].differences, found["PCM"].differences
    assert dann is not None
    assert pcm is not None
    assert dann[0].mean == pytest.approx(0.2)
    assert (dann[0].seeds, dann[0].meshes) == (3, 20)
    assert pcm[0].mean == 0
    assert found["GAST"].why == "not run"
    shown = text(list(found.values()), "source only")
    assert "minus source only" in shown
    assert "DANN" in shown
    assert "+20.0 [" in shown
    assert "(20 meshes)" in shown
    assert "GAST" in next(line for line in shown.splitlines() if line.endswith(": not run"))
    assert "simulated" not in shown
    for markdown in (False, True):
        shown = text(list(found.values()), "source only", markdown, table)
        assert shown.splitlines()[0].removeprefix("## ") == table.title
        assert "SIMULATED target: kinectsim10" in shown.splitlines()
    rows = list(csv.DictReader(io.StringIO(csv_text([*found.values()], "source only"))))
    assert len(rows) == 2 * len(found)
    assert {row["minus"] for row in rows} == {"source only"}
    (row,) = (r for r in rows if (r["name"], r["metric"]) == ("DANN", "accuracy"))
    assert float(row["difference"]) == pytest.approx(20)
    assert (row["seeds"], row["clusters"], row["simulated"]) == ("3", "20", "true")
    assert (row["clouds"], row["clusters_are"]) == ("all", "meshes")
    with pytest.raises(ConfigError, match="no row 'x'"):
        against(table, "x")
    why = {one.name: one.why for one in against(table, "GAST")}
    assert why["PCM"] == "GAST, target test: not run"
    assert why["DefRec"] == "not run"


def test_runs_are_not_compared_with_themselves(tmp_path):
    """Overrides may make two rows one."""
    run = "target test: {run: experiment=source_only_s2d method=dann}"
    lines = ("title: t", "metrics: [accuracy]", "columns: [target test]", "rows:")
    rows = (f"  - name: {name}\n    {run}" for name in "ab")
    (tmp_path / "own.yaml").write_text("\n".join([*lines, *rows]))
    table = fill(tmp_path, str(tmp_path / "own.yaml"), {("a", "target test"): 10})
    (one,) = against(table, "a")
    assert (one.name, one.why) == ("b", "the same runs: their settings do not differ")


def test_what_a_table_does_not_average_is_not_compared(tmp_path):
    place = "target test"
    table = fill(tmp_path, "cad10", {("source only", place): 10, ("DANN", place): 14})
    cells = {cell.row: cell for cell in table.cells if cell.group}
    shown = text(against(table, "source only"), "source only")
    assert "each counts as one of its own" in shown  # these predictions know no objects

    def compared(folder, target):
        change(folder, data=DataHashes(source="a" * 64, target=target))
        again = build_table("cad10", tmp_path)
        (one,) = (one for one in against(again, "source only") if one.name == "DANN")
        return one

    folders = [run.folder for run in cells["DANN"].group.finished]
    one = compared(folders[0], "c" * 64)
    assert one.differences is None
    assert "not averaged" in one.why
    compared(folders[1], "c" * 64)
    one = compared(folders[2], "c" * 64)  # all of its seeds, but not the base's
    assert one.differences is None
    target = cells["DANN"].group.first.target
    versions = f"the runs saw different versions of {target}: cccccccccccc and bbbbbbbbbbbb"
    assert one.why == versions
    for run in cells["DANN"].group.finished:
        change(run.folder, made_of=DataMadeOf(source=CATALOGUE, target=replace(CATALOGUE, views=3)))
    one = compared(folders[2], "c" * 64)
    assert f"cccccccccccc ({replace(CATALOGUE, views=3)}) and bbbbbbbbbbbb (" in one.why
    for run in cells["DANN"].group.finished:
        change(run.folder, target="nyuv2")
    one = compared(folders[2], "c" * 64)
    assert one.why == f"the runs have different targets: nyuv2 and {target}"
    for run in cells["DANN"].group.finished:
        change(run.folder, target=target)
    made = DataMadeOf(source=CATALOGUE, target=replace(CATALOGUE, recipe="1" * 12))
    for cell in cells.values():  # other bytes of one recipe are one target
        for run in cell.group.finished:
            change(run.folder, made_of=made)
    one = compared(folders[2], "c" * 64)
    assert one.differences is not None


def test_objects_that_are_known_are_counted(tmp_path):
    """Twenty clouds of four objects."""
    place = "target test"
    table = fill(tmp_path, "cad10", {("source only", place): 10, ("DANN", place): 14})
    names = tuple(map(str, range(20)))
    for cell in table.cells:
        for run in cell.group.finished if cell.group else ():
            said = read_predictions(run.folder / FILE)
            meshes = tuple(str(i // 5) for i in range(20))
            known = Predictions(said.classes, names, meshes, said.labels, said.probabilities)
            write_predictions(run.folder / FILE, known)
    (one,) = (one for one in against(table, "source only") if one.differences)
    assert one.differences[0].meshes == 4
    assert "each counts as one of its own" not in text([one])


def test_each_tier_is_compared_by_itself(tmp_path):
    """Ten clean and ten hard clouds in four blocks of frames; one run alone saved the tiers."""
    place = "target test"
    table = fill(tmp_path, "cad10", {("source only", place): 5, ("DANN", place): 13})
    tiers = {"clean": scores(0.5), "hard": scores(0.5)}
    known = Evaluated(split="test", labels=True, rotations=0, norms="trained", tiers=tiers)
    folders = [run.folder for c in table.cells if c.group for run in c.group.finished]
    for i, folder in enumerate(folders):
        change(folder, evaluation=known)
        said = read_predictions(folder / FILE)
        said = replace(said, meshes=tuple(f"block{i // 5:04d}" for i in range(20)))
        last = i == len(folders) - 1
        write_predictions(
            folder / FILE, replace(said, tiers=("clean",) * 10 + ("hard",) * 10) if last else said
        )
    found = against(build_table("cad10", tmp_path), "source only")
    (one,) = (one for one in found if one.differences)
    means = {name: pair[0].mean for name, pair in one.subsets.items()}
    assert means == pytest.approx({"all": 0.4, "clean": 0.5, "hard": 0.3})
    assert {name: pair[0].meshes for name, pair in one.subsets.items()} == {
        "all": 4, "clean": 2, "hard": 2
    }  # fmt: skip
    shown = text(found, "source only", table=table)
    assert "over seeds and test blocks of frames (4 blocks of frames)" in shown
    assert "meshes" not in shown.partition("data: ")[0]
    assert [line.split()[:2] for line in shown.splitlines() if line.startswith("DANN")] == [
        ["DANN", "all"], ["DANN", "clean"], ["DANN", "hard"],
    ]  # fmt: skip
    rows = list(csv.DictReader(io.StringIO(csv_text(found))))
    hard = next(row for row in rows if (row["name"], row["clouds"]) == ("DANN", "hard"))
    assert float(hard["difference"]) == pytest.approx(30)
    assert (hard["clusters"], hard["clusters_are"]) == ("2", "blocks of frames")
    assert hard["source_made_of"] == hard["other_source_made_of"] == "published files"
    assert hard["target_made_of"] == str(CATALOGUE)

    # rendered from one recipe by two kinds of processors: the run that knows saw other bytes
    made = DataMadeOf(source=CATALOGUE, target=replace(CATALOGUE, recipe="r" * 12))
    for folder in folders:
        seen = "c" if folder == folders[-1] else "b"
        change(folder, data=DataHashes(source="a" * 64, target=seen * 64), made_of=made)
    found = against(build_table("cad10", tmp_path), "source only")
    assert [list(one.subsets) for one in found if one.differences] == [["all", "clean", "hard"]]

    plain = replace(read_predictions(folders[-1] / FILE), tiers=())
    write_predictions(folders[-1] / FILE, plain)
    found = against(build_table("cad10", tmp_path), "source only")
    assert [list(one.subsets) for one in found if one.differences] == [["all"]]
    assert "clean and hard clouds are not told apart" in text(found, "source only")


def test_effects_by_hand(tmp_path):
    scratch, source = "from scratch on the target", "continued, with source"
    half = {
        ("QBST", scratch): 8,
        ("QBST", source): 14,
        ("SPST", scratch): 10,
        ("SPST", source): 12,
    }
    scheme = f"{source} minus {scratch}, over QBST, SPST, CBST, all confident"
    found = {one.name: one for one in effects(fill(tmp_path / "half", "factorial", half))}
    lacking = [f"{row}, {at}" for row in ("CBST", "all confident") for at in (source, scratch)]
    assert found[scheme].why == f"{'; '.join(lacking)}: not run"  # two rows of four have theirs
    spst = found[f"SPST minus QBST, over {scratch}, {source}"].differences
    assert spst is not None
    assert spst[0].mean == pytest.approx(0)  # (10 - 8 + 12 - 14) / 40
    # no column changes the teacher of all, so it says nothing of columns
    assert not any("none" in name.split(", over ")[1] for name in found)

    rest = {(row, column): 9 for row in ("CBST", "all confident") for column in (scratch, source)}
    table = fill(tmp_path / "all", "factorial", {**half, **rest})
    (one,) = (one for one in effects(table) if one.name == scheme)
    assert one.differences is not None
    assert one.differences[0].mean == pytest.approx((6 + 2 + 0 + 0) / 4 / 20)
    assert "+10.0 [" in text([one])


CROSSED = """
title: Two by two
metrics: [accuracy]
columns: [K]
rows:
  - {name: before, run: experiment=cad10}
  - name: a
    factors: {selector: QBST, scheme: fresh}
    run: experiment=cad10 selftraining=qbst selftraining.theta=0.1
  - name: b
    factors: {selector: QBST, scheme: goes on}
    run: experiment=cad10 selftraining=qbst selftraining.theta=0.2
  - name: c
    factors: {selector: SPST, scheme: fresh}
    run: experiment=cad10 selftraining=qbst selftraining.theta=0.3
  - name: d
    factors: {scheme: goes on, selector: SPST}
    run: experiment=cad10 selftraining=qbst selftraining.theta=0.4
"""


def test_effects_of_rows_that_cross_two_factors(tmp_path):
    """Of twenty clouds 8 and 14, and 9 and 12 are right."""
    path = tmp_path / "crossed.yaml"
    path.write_text(CROSSED)
    right = {("before", "K"): 3, ("a", "K"): 8, ("b", "K"): 14, ("c", "K"): 9, ("d", "K"): 12}
    found = {one.name: one for one in effects(fill(tmp_path / "runs", str(path), right))}
    assert list(found) == [
        "selector: SPST minus QBST, over fresh; goes on",
        "scheme: goes on minus fresh, over QBST; SPST",
    ]
    selector, scheme = (one.differences[0].mean for one in found.values())
    assert selector == pytest.approx((9 - 8 + 12 - 14) / 2 / 20)
    assert scheme == pytest.approx((14 - 8 + 12 - 9) / 2 / 20)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("SPST, scheme: fresh", "QBST, scheme: fresh", "row 'c' has the factors of row 'a'"),
        ("scheme: goes on, selector: SPST", "scheme: goes on", "row 'd': its factors are scheme,"),
        ("scheme: goes on, selector: SPST", "scheme: 1, selector: SPST", "row 'd': .*be words"),
        ("{scheme: goes on, selector: SPST}", "SPST", "missing or wrong entry"),
    ],
)
def test_factors_that_cross_nothing(tmp_path, old, new, message):
    path = tmp_path / "crossed.yaml"
    path.write_text(CROSSED.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        build_table(str(path), tmp_path)


def test_the_last_rows_of_headline_are_two_selectors_by_two_schemes(tmp_path):
    table = build_table("headline", tmp_path)
    levels = [tuple(one.values()) for one in table.factors.values()]
    assert len(set(levels)) == 4
    assert [len({level[i] for level in levels}) for i in (0, 1)] == [2, 2]
    assert list(table.factors) == list(table.rows)[-4:]
    for row, (selector, scheme) in zip(table.factors, levels, strict=True):
        words = table.rows[row][0].overrides
        assert f"selftraining={selector.lower()}" in words
        # QBST is fresh by itself, SPST goes on by itself
        stated = any(word.startswith("selftraining.init=") for word in words)
        assert stated == ((selector == "QBST") == scheme.startswith("the teacher"))
    assert len(effects(table)) == 2


@pytest.mark.slow
def test_a_table_of_real_trainings(tmp_path):
    """Two rows, two seeds, two at a time; a second call has nothing to do; rows are compared."""
    write_toy(tmp_path / "data")
    toy = [word for word in overrides(tmp_path)[1:] if not word.startswith("paths.")]
    rows = [word for word in toy if not word.startswith("selftraining.")]
    options = [
        "table=quickstart", f"log_dir={tmp_path / 'logs'}", f"data_dir={tmp_path / 'data'}",
        f"overrides={shlex.join(rows)}",
    ]  # fmt: skip

    def report(*words):
        return subprocess.run(
            [sys.executable, "-m", "qs3", "report", *words, *options],
            cwd=ROOT, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
            check=False,
        )  # fmt: skip

    first = report("train", "rows=speckle", "seeds=0,1", "jobs=2")
    assert first.returncode == 0, first.stdout + first.stderr
    assert "4 runs to do" in first.stdout
    words = shlex.split(first.stdout.splitlines()[-1])
    assert words[:3] == ["next:", "qs3", "report"]
    assert {*words[3:]} == {*options}  # a table of other options has no runs
    assert "n_jobs=2" in first.stdout
    again = report("train", "rows=speckle", "seeds=0,1")
    assert "0 runs to do" in again.stdout
    more = ["rows=(S)", "seeds=0,1,2,3", "hydra.launcher.verbose=1"]
    launched = report("train", *more, "launcher=joblib", "jobs=2")
    assert launched.returncode == 0, launched.stdout + launched.stderr
    assert "n_jobs=2" in launched.stdout
    assert " 2 (!)" in launched.stdout  # the summary of the two that were missing
    again = report("train", "rows=(S)", "seeds=0,1,2,3", "launcher=submitit_local")
    assert again.returncode == 0
    assert "0 runs to do" in again.stdout
    compared = report("compare", "base=source only, speckle scans (S)")
    assert compared.returncode == 0, compared.stderr
    assert "QS3 = PCM + QBST, speckle scans  " in compared.stdout
    assert "PCM, speckle scans: a warm-up's predictions are not kept" in compared.stdout
    (page,) = (tmp_path / "logs" / "tables").glob("quickstart-*-compared.md")  # of these overrides
    assert page.stat().st_size
