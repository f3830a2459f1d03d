"""Mean and SEM, and above all what must not be averaged."""

import json
import math
import re
import statistics
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.report.tables.aggregate import (
    Stat,
    data_lines,
    group,
    load_run,
    load_runs,
    same_data,
    summarise,
)
from qs3.runs.metrics import DataHashes, DataMadeOf, Evaluated
from qs3.training.command import headline
from tests.report.made_runs import CATALOGUE, metrics, scores, write_run


def test_mean_and_sem_by_hand():
    stat = Stat.of([0.1, 0.2, 0.6])
    assert stat.mean == pytest.approx(0.3)
    assert stat.sem == pytest.approx(math.sqrt((0.04 + 0.01 + 0.09) / 2 / 3))
    assert stat.n == 3
    assert Stat.of([0.64, 0.66, 0.62]).percent() == "64.0 ± 1.2"
    assert Stat.of([0.5]) == Stat(0.5, None, 1)
    assert Stat.of([0.5]).percent() == "50.0"


@given(st.lists(st.floats(0, 1), min_size=2, max_size=9))
def test_agrees_with_the_standard_library(values):
    stat = Stat.of(values)
    assert stat.mean == pytest.approx(statistics.fmean(values), abs=1e-12)
    expected = statistics.stdev(values) / math.sqrt(len(values))
    assert stat.sem == pytest.approx(expected, abs=1e-9)


def test_groups_by_hash_not_by_seed(tmp_path):
    for seed in (2, 0, 1):
        write_run(tmp_path, seed=seed, accuracy=0.5 + seed / 100)
    write_run(tmp_path, hash="ffff0000", accuracy=0.9)
    groups = {g.hash: g for g in group(load_runs(tmp_path))}
    assert set(groups) == {"0123abcd", "ffff0000"}
    assert groups["0123abcd"].seeds == [0, 1, 2]
    stat = groups["0123abcd"].stat("accuracy")
    assert stat is not None
    assert (stat.mean, stat.n) == (pytest.approx(0.51), 3)
    assert groups["0123abcd"].problems == ()


def test_tiers_are_averaged_where_every_seed_has_them(tmp_path):
    def run(seed, clean, **tiers):
        known = {"clean": scores(clean), **tiers} if clean is not None else None
        evaluation = Evaluated(split="test", labels=True, rotations=0, norms="trained", tiers=known)
        write_run(tmp_path, seed=seed, evaluation=evaluation)

    run(0, 0.5)
    run(1, 0.7, hard=scores(0.2))
    (found,) = group(load_runs(tmp_path))
    assert found.stat("accuracy_clean").mean == pytest.approx(0.6)
    assert found.stat("balanced_accuracy_clean").mean == pytest.approx(0.5)
    assert found.stat("accuracy_hard") is None  # of one seed alone
    assert found.stat("accuracy_clean", "warmup") is None
    run(2, None)
    (found,) = group(load_runs(tmp_path))
    assert found.stat("accuracy_clean") is None
    assert found.stat("accuracy").n == 3


def test_unfinished_failed_and_damaged_seeds_are_shown(tmp_path):
    write_run(tmp_path, seed=0)
    begun = tmp_path / "exp" / "seed1-0123abcd"
    begun.mkdir()
    (begun / "started.json").write_text("{}")
    (write_run(tmp_path, seed=2) / "metrics.json").write_text('{"seed": 2, "sta')
    failed = write_run(tmp_path, seed=3) / "metrics.json"
    failed.write_text(failed.read_text().replace('"finished"', '"failed"'))
    (write_run(tmp_path, seed=4) / "metrics.json").write_text("[]")
    (found,) = group(load_runs(tmp_path))
    assert found.seeds == [0]
    text = "\n".join(found.problems)
    assert f"seed 1: unfinished ({begun})" in text
    assert re.search(r"seed 2: .*metrics\.json is damaged: the file: Invalid JSON", text)
    assert re.search(r"seed 3: .*metrics\.json is damaged: status: .*'finished'", text)
    assert re.search(r"seed 4: .*metrics\.json is damaged: the file: ", text)
    stat = found.stat("accuracy")
    assert stat is not None
    assert stat.n == 1


@pytest.mark.parametrize("role", ["source", "target"])
def test_other_data_are_not_averaged(tmp_path, role):
    write_run(tmp_path, seed=0)
    write_run(tmp_path, seed=1)
    data = {"source": "a" * 64, "target": "b" * 64, role: "c" * 64}
    write_run(tmp_path, seed=2, data=DataHashes(**data))
    (found,) = group(load_runs(tmp_path))
    assert found.stat("accuracy") is None
    assert f"the {role} dataset differs" in found.problems[0]
    assert "seeds 2: cccccccccccc" in found.problems[0]
    assert "not averaged" in summarise([r.folder for r in load_runs(tmp_path)])
    again = write_run(tmp_path / "again", seed=0)
    (found,) = group(load_runs(tmp_path))
    assert "seeds 0 occur more than once" in found.problems[0]
    both = [str(run.folder) for run in load_runs(tmp_path) if run.seed == 0]
    assert str(again) in both
    assert f"({', '.join(both)})" in found.problems[0]  # or nobody knows what to put away


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"data": DataHashes(source="a" * 64, target="b" * 64, beside="c" * 64)}, "twins or views"),
        ({"versions": {"qs3": "0.1.0", "weights": "teacher " + "d" * 64}}, "the classifier that"),
    ],
)
def test_other_twins_and_other_teachers_are_not_averaged(tmp_path, changes, said):
    write_run(tmp_path, seed=0)
    write_run(tmp_path, seed=1, **changes)
    (found,) = group(load_runs(tmp_path))
    assert found.stat("accuracy") is None
    assert said in found.problems[0]


def test_a_source_that_nobody_used_tells_no_runs_apart(tmp_path):
    """The upper bound's, which older files name."""
    for seed, source in enumerate("ac"):
        data = DataHashes(source=source * 64, target="b" * 64)
        write_run(
            tmp_path,
            seed=seed,
            source="kinectsim10",
            target="kinectsim10",
            data=data,
            method="supervised",
        )
    (found,) = group(load_runs(tmp_path))
    assert found.stat("accuracy").n == 2
    assert found.problems == ()


@pytest.mark.parametrize("role", ["source", "target"])
def test_one_recipe_on_two_machines_is_averaged_and_said(tmp_path, role):
    """Bytes of renderings differ by processor; recipes do not."""

    def run(seed, sha, recipe):
        made = {"source": CATALOGUE, "target": CATALOGUE, role: replace(CATALOGUE, recipe=recipe)}
        data = {"source": "a" * 64, "target": "b" * 64, role: sha * 64}
        write_run(tmp_path, seed=seed, data=DataHashes(**data), made_of=DataMadeOf(**made))

    run(0, "c", "1" * 12)
    run(1, "d", "1" * 12)
    (found,) = group(load_runs(tmp_path))
    assert found.stat("accuracy").n == 2
    said = f"the {role} was made by one recipe on several machines"
    assert said in found.notes[0]
    assert "seeds 0: cccccccccccc; seeds 1: dddddddddddd" in found.notes[0]
    assert found.problems == ()
    assert said in summarise([r.folder for r in load_runs(tmp_path)])
    run(2, "c", "2" * 12)  # by other code
    (found,) = group(load_runs(tmp_path))
    assert found.stat("accuracy") is None
    run(3, "e", "")  # nobody knows
    (found,) = group(r for r in load_runs(tmp_path) if r.seed != 2)
    assert found.stat("accuracy") is None
    (found,) = group(r for r in load_runs(tmp_path) if r.seed in (0, 2))
    assert found.stat("accuracy").n == 2  # the same bytes, whoever made them
    assert found.problems == ()


def test_code_that_was_edited_between_seeds_is_said(tmp_path):
    """An edited net's seeds were one row with the old net's, without a word."""
    for seed, own in enumerate(("a", "a", "b", None, 5, 6)):
        write_run(tmp_path, seed=seed)
        files = {"qs3's code": "q", "/nets": own} if own in ("a", "b") else own
        started = tmp_path / "exp" / f"seed{seed}-0123abcd" / "started.json"
        started.write_text(json.dumps({"files": files}))
    started.write_text("{")  # damaged: nobody knows
    (found,) = group(load_runs(tmp_path))
    assert found.comparable
    assert found.notes == ("/nets was edited between seeds 0, 1 and 2: averaged",)


def test_scores_that_a_seed_lacks_have_no_mean(tmp_path):
    write_run(tmp_path, seed=0, final=scores(0.5, calibration_error=0.25))
    (found,) = group(load_runs(tmp_path))
    assert found.stat("calibration_error") == Stat(0.25, None, 1)
    write_run(tmp_path, seed=1, accuracy=0.7)  # diverged
    (found,) = group(load_runs(tmp_path))
    assert found.stat("calibration_error") is None
    assert found.stat("accuracy").mean == pytest.approx(0.6)
    assert found.stat("accuracy", "warmup").mean == 0.5


def test_a_diverged_seed_is_averaged_and_said(tmp_path):
    for seed, entropy in ((0, -0.4), (1, None)):
        write_run(tmp_path, seed=seed, accuracy=0.5, validators={"entropy": entropy})
    (one,) = group(load_runs(tmp_path))
    assert one.comparable
    assert one.problems == ("seeds 1: the net has diverged and calls every cloud alike: averaged",)
    said = [headline(result) for result in one.results]
    assert "diverged" not in said[0]
    assert "seed 1: the net has diverged, its predictions are no numbers; accuracy 50.0%" in said[1]


def test_without_labels_there_is_no_mean(tmp_path):
    write_run(tmp_path, accuracy=None)
    (found,) = group(load_runs(tmp_path))
    assert found.unlabelled
    assert found.stat("accuracy") is found.stat("balanced_accuracy") is None
    assert "no target labels, so no accuracy" in summarise([found.finished[0].folder])


def test_summary_of_a_multirun(tmp_path):
    folders = [write_run(tmp_path, seed=s, accuracy=0.62 + 0.02 * s) for s in range(3)]
    folders += [write_run(tmp_path, hash="ff00", method="source_only", selftraining="none")]
    folders += [tmp_path / "exp" / "seed1-ff00"]
    lines = summarise(folders).splitlines()
    assert "mean ± SEM over seeds" in lines[0]
    assert lines[1].split("  ")[0] == "experiment"
    assert "specklenet10 -> kinectsim10 (simulated target)" in lines[3]
    for part in ("pcm", "qbst", "64.0 ± 1.2", "54.0 ± 1.2"):
        assert part in lines[3]
    assert lines[3].endswith("  45.0")  # a property of the data: no SEM
    assert "1 (!)" in lines[4]
    assert lines[5] == f"exp ff00, seed 1: no result ({tmp_path / 'exp' / 'seed1-ff00'})"
    assert lines[6] == "(!) fewer than 3 seeds"
    starts = [line.index("  ") for line in lines[1:3]]
    assert len(set(starts)) == 1


def test_load_run_of_another_name(tmp_path):
    assert "no result" in summarise([tmp_path / "exp" / "seed0-ab"])
    run = load_run(tmp_path / "elsewhere")
    assert (run.seed, run.status) == (None, "unfinished")


def test_an_older_word_for_the_same_data_is_not_a_second_line():
    old = replace(CATALOGUE, benchmark="like roomscan10 v4, but not it (other settings or objects)")
    new = replace(CATALOGUE, benchmark="roomscan10 v4, train", recipe="1" * 12)
    runs = [metrics(made_of=DataMadeOf(source=made, target=CATALOGUE)) for made in (old, new, old)]
    target = f"data: kinectsim10: {CATALOGUE}"
    assert data_lines(runs) == [f"data: specklenet10: {new}", target]
    other = replace(runs[0], data=DataHashes(source="e" * 64, target="b" * 64))
    assert data_lines([*runs, other])[-1] == f"data: specklenet10: {old}"  # other bytes
    assert same_data(runs, "source")


def test_data_of_one_name_have_a_line_each():
    """As two folders of own clouds, which are both called so."""
    made = DataMadeOf(source=replace(CATALOGUE, objects="others"), target=CATALOGUE)
    run = replace(metrics(made_of=made), source="own", target="own")
    lines = [f"data: own (source): {made.source}", f"data: own (target): {made.target}"]
    assert data_lines([run, run]) == lines
    same = replace(run, made_of=DataMadeOf(source=CATALOGUE, target=CATALOGUE))
    assert data_lines([same]) == [f"data: own: {CATALOGUE}"]
