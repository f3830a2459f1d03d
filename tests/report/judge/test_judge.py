"""Runs judged on an archive: by hand, by family, by tier; intervals that take rooms together."""

import csv
import json
from functools import partial

import numpy as np
import pytest
import torch

from qs3.__main__ import QS3
from qs3.classes import CLASSES
from qs3.datasets.importers.object_archive import read_archive
from qs3.errors import ConfigError, MissingDataError
from qs3.inference.model_file import Result, write_result
from qs3.inference.predictor import load
from qs3.models.pointnet import pointnet
from qs3.report.clustered import weights
from qs3.report.judge.answers import find_runs
from qs3.report.judge.intervals import difference, share
from qs3.report.judge.judging import _families, judge
from qs3.report.judge.text import text
from qs3.report.tables.paired import interval
from qs3.utils.version import VERSION, commit, in_words
from tests.fixtures.frame_files import write_archive
from tests.report.made_runs import write_run

MODEL = {"_target_": "qs3.models.pointnet.pointnet"}


def add_net(folder, seed, *, classes=CLASSES, **changes):
    """A run's result.pt of an untrained net; its last bias makes it name several classes."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        net = pointnet(num_classes=len(classes))
    values = {
        "model": {**MODEL, "num_classes": len(classes)}, "classes": tuple(classes),
        "points": 64, "stored_points": 128, "target": "kinectsim10", "gravity": "z",
        "scale": "unit_ball", "usual": {}, "weights": net.state_dict(),
    }  # fmt: skip
    write_result(folder / "result.pt", Result(**{**values, **changes}))
    return folder


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    path = tmp_path_factory.mktemp("judge") / "held_back.npz"
    write_archive(path, {"train": 1, "test": 5}, points=150)
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two seeds of one config, and one of another."""
    root = tmp_path_factory.mktemp("logs")
    for seed, more in ((0, {}), (1, {"commit": "c0ffee"})):
        add_net(write_run(root, seed=seed, versions={"qs3": "0.1.0", **more}), seed)
    add_net(write_run(root, experiment="other", hash="ffff0000"), 5)
    return root


def test_by_hand(archive, logs):
    verdict = judge([str(logs / "exp")], archive)
    (family,) = verdict.families
    assert (family.name, family.seeds) == ("exp 0123abcd", (0, 1))
    assert verdict.part == "judge"
    held = read_archive(archive)
    kept = np.flatnonzero(held.dev == "judge")
    truth = np.array([CLASSES.index(name) for name in held.cls[kept]])
    right = []
    for file in family.runs:
        found = load(file)([held.cloud(i, True) for i in kept]).argmax(1)
        right.append(found == truth)
    right = np.stack(right)
    everything, *tiers = family.figures
    assert (everything.n, everything.majority) == (50, 0.1)
    assert everything.accuracy.mean == pytest.approx(right.mean())
    per_seed = right.mean(axis=1)
    assert everything.accuracy.sem == pytest.approx(per_seed.std(ddof=1) / np.sqrt(2))
    for tier in tiers:
        mine = held.tier[kept] == tier.tier
        assert tier.n == mine.sum()
        assert tier.accuracy.mean == pytest.approx(right[:, mine].mean())
        recalls = [right[:, mine & (truth == k)].mean() for k in np.unique(truth[mine])]
        assert tier.balanced.mean == pytest.approx(np.mean(recalls))
    assert sum(tier.n for tier in tiers) == everything.n
    assert sum(everything.predicted.values()) == pytest.approx(everything.n)


def test_classes_of_one_block_are_named(archive, logs, tmp_path):
    """Their recalls add nothing to the interval, which is too narrow then: it is said."""
    plain = text(judge([str(logs / "other")], archive))
    assert "one block alone" not in plain
    arrays = dict(np.load(archive))
    beds = np.flatnonzero((arrays["cls"] == "bed") & (arrays["dev"] == "judge"))
    arrays["cls"][beds[1:]] = "sofa"
    np.savez(tmp_path / "held_back.npz", **arrays)
    verdict = judge([str(logs / "other")], tmp_path / "held_back.npz")
    assert {f.tier: f.alone for f in verdict.families[0].figures} == {
        "all": ("bed",), "clean": ("bed",), "hard": ()
    }  # fmt: skip
    assert "(!) seen in one block alone: bed (all); bed (clean). How they vary" in text(verdict)


def test_families_parts_and_classes(archive, logs):
    verdict = judge([str(logs)], archive, part="adapt", classes=["chair", "sofa"])
    assert [family.name for family in verdict.families] == ["exp 0123abcd", "other ffff0000"]
    assert verdict.families[1].figures[0].accuracy.sem is None
    assert verdict.families[0].figures[0].counts == {"chair": 1, "sofa": 1}
    assert verdict.left_out == 8
    with pytest.raises(ConfigError, match=r"part=x.*adapt, gap, judge"):
        judge([str(logs)], archive, part="x")
    with pytest.raises(ConfigError, match="throne"):
        judge([str(logs)], archive, classes=["throne"])


def test_runs_of_other_classes_are_judged_on_what_all_know(archive, logs, tmp_path):
    few = add_net(tmp_path, 3, classes=("sofa", "chair", "bed"))
    verdict = judge([str(logs / "other"), str(few)], archive)
    assert verdict.classes == ("bed", "chair", "sofa")
    assert {family.figures[0].n for family in verdict.families} == {15}
    assert verdict.families[1].name == str(few / "result.pt")
    standing = add_net(tmp_path, 3, scale="above_floor", floor_m=0.0)
    with pytest.raises(ConfigError, match=r"heights above the floor, .* clouds stand at 0"):
        judge([str(standing)], archive)
    low, high = (judge([str(standing)], archive, floor=floor) for floor in (-1.2, -25.0))
    assert low.families[0].figures != high.families[0].figures
    assert "the floor lies at -1.2 m" in text(low)
    with pytest.raises(MissingDataError, match=r"none\.npz"):
        judge([str(standing)], tmp_path / "none.npz")
    with pytest.raises(MissingDataError, match=r"is a folder; an archive .* one file, \.npz"):
        judge([str(standing)], tmp_path)
    with pytest.raises(ConfigError, match="part=x"):
        judge([str(standing)], archive, part="x")
    camera = add_net(tmp_path, 3, gravity="none")
    with pytest.raises(ConfigError, match="frame of their camera"):
        judge([str(camera)], archive)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"floor": float("nan")}, "floor must be a finite number"),
        ({"prior": "chair:4", "prior_power": float("inf")}, "prior_power must be"),
        ({"prior": "chair:4", "prior_power": -1.0}, "prior_power must be"),
    ],
)
def test_figures_that_are_none_are_refused(archive, logs, told, message):
    with pytest.raises(ConfigError, match=message):
        judge([str(logs / "other")], archive, **told)


def test_runs_are_found(logs, tmp_path):
    assert len(find_runs([str(logs)])) == 3
    assert len(find_runs([f"{logs}/exp/seed*", str(logs / "exp")])) == 2
    for words in (str(tmp_path / "nothing"), f"{logs}/no*", str(tmp_path)):
        with pytest.raises(MissingDataError):
            find_runs([words])


def test_classifiers_that_come_with_qs3_have_their_names(tmp_path):
    """As they were typed; a row was called as the file in which the package keeps its weights."""
    files = find_runs(["dgcnn-rooms", str(add_net(tmp_path, 0))])
    assert [file.name for file in files] == ["model.safetensors", "result.pt"]
    names = [family.name for family in _families(files)]
    assert names == ["dgcnn-rooms", str(tmp_path / "result.pt")]


def test_the_same_run_twice(archive, logs, tmp_path):
    import shutil

    (run,) = (logs / "other").iterdir()
    shutil.copytree(run, tmp_path / run.name)
    with pytest.raises(ConfigError, match="the same run twice"):
        judge([str(run), str(tmp_path)], archive)


def test_command(archive, logs, tmp_path, capsys):
    words = ["report", "judge", f"runs={logs}", f"data={archive}"]
    assert QS3([*words, f"out={tmp_path}/judged.csv"]) == 0
    said = capsys.readouterr().out
    assert "real objects" in said
    assert "exp 0123abcd" in said
    assert "hard" in said
    rows = list(csv.DictReader((tmp_path / "judged.csv").read_text().splitlines()))
    assert [row["tier"] for row in rows] == ["all", "clean", "hard"] * 2
    assert rows[0]["objects_chair"] == "5"
    assert [row["less"] for row in rows] == [""] * 3 + ["exp 0123abcd"] * 3
    made = "specklenet10 (published files), kinectsim10 (embedded catalogue, kinect_like, 4 views)"
    assert (rows[0]["data"], rows[0]["trained_by"]) == (made, "qs3 0.1.0; qs3 0.1.0, commit c0ffee")
    assert rows[0]["judged_by"] == in_words(VERSION, commit())
    assert f"data of exp 0123abcd: {made}\n" in said
    assert "trained by, exp 0123abcd: qs3 0.1.0; qs3 0.1.0, commit c0ffee\n" in said
    assert f"judged by {rows[0]['judged_by']}\n" in said
    assert QS3([*words, f"out={tmp_path}/judged.json"]) == 0
    found = json.loads((tmp_path / "judged.json").read_text())
    assert found["families"][0]["figures"][0]["accuracy"]["mean"] == float(rows[0]["accuracy"])
    for row, less in zip(rows[3:], found["differences"], strict=True):
        assert (row["tier"], row["less"]) == (less["tier"], less["base"])
        assert float(row["accuracy_more"]) == less["accuracy"]["mean"]
        assert float(row["balanced_more_low"]) == less["balanced"]["low"]
    with pytest.raises(ConfigError, match=r"\.csv or \.json"):
        QS3([*words, "out=x.txt"])


def test_intervals_by_hand():
    """One seed, two objects a block: the variance of four sums, by Student with 3 degrees."""
    right = np.array([[1, 1, 1, 0, 0, 0, 1, 1]], dtype=bool)
    labels, blocks = np.zeros(8, int), np.repeat(np.arange(4), 2)
    found = share(right, labels, blocks)
    sums = np.array([3 / 4, -1 / 4, -5 / 4, 3 / 4]) / 8  # about the mean 5/8
    half = 3.182446 * np.sqrt((sums**2).sum() * 4 / 3)
    assert found.mean == 5 / 8
    assert found.low == pytest.approx(max(0, 5 / 8 - half))
    assert found.high == pytest.approx(min(1, 5 / 8 + half))
    assert share(right, labels, np.zeros(8)).low is None


def test_balanced_intervals_by_hand():
    """Class 0 twice in each of five rooms, class 1 once in four of them, class 2 in one alone."""
    right = np.array([[1, 1, 1, 0, 1, 1, 0, 1, 1, 1, 1, 1, 0, 1, 1, 0]], dtype=bool)
    labels, blocks = np.repeat([0, 1, 2], [10, 4, 2]), [*np.repeat(range(5), 2), 0, 1, 2, 3, 4, 4]
    found = share(right, labels, np.array(blocks), balanced=True)
    first = np.array([0.4, -0.6, 0.4, -0.6, 0.4]) / 10 / 3 / np.sqrt(1 - 1 / 5)  # about 0.8
    second = np.array([0.25, 0.25, -0.75, 0.25, 0]) / 4 / 3 / np.sqrt(1 - 1 / 4)  # about 0.75
    half = 2.776445 * np.sqrt(((first + second) ** 2).sum() * 5 / 4)
    mean = (0.8 + 0.75 + 0.5) / 3
    assert (found.low, found.mean, found.high) == pytest.approx((mean - half, mean, mean + half))


@pytest.mark.parametrize("balanced", [False, True])
def test_differences_are_those_of_report_compare(balanced):
    rng = np.random.default_rng(2)
    labels, blocks = rng.integers(0, 4, 80), np.sort(rng.integers(0, 9, 80))
    a, b = rng.random((3, 80)) < 0.5, rng.random((3, 80)) < 0.5
    found = difference(a, b, labels, blocks, balanced=balanced)
    theirs = interval(a.astype(float) - b, weights(labels, balanced), blocks)
    assert (found.mean, found.low, found.high) == pytest.approx(
        (theirs.mean, theirs.low, theirs.high)
    )


def test_differences_are_paired():
    """Two rows that are right about other objects of the same rooms; and a row less itself."""
    rng = np.random.default_rng(1)
    labels, blocks = rng.integers(0, 3, 60), np.repeat(np.arange(12), 5)
    a, b = rng.random((2, 60)) < 0.7, rng.random((2, 60)) < 0.5
    for balanced in (False, True):
        found = difference(a, b, labels, blocks, balanced=balanced)
        alone = [share(x, labels, blocks, balanced=balanced).mean for x in (a, b)]
        assert found.mean == pytest.approx(alone[0] - alone[1])
        assert found.low < found.mean < found.high
    same = difference(a, a, labels, blocks)
    assert (same.mean, same.low, same.high) == (0, 0, 0)
    assert difference(a, b[:1], labels, blocks).sem is None  # other numbers of seeds


def test_the_others_are_compared_with_the_first(archive, logs):
    verdict = judge([str(logs / "exp"), str(logs / "other")], archive)
    first, other = (family.figures for family in verdict.families)
    assert [d.tier for d in verdict.differences] == ["all", "clean", "hard"]
    seed0 = judge([str(logs / "exp" / "seed0-0123abcd")], archive).families[0].figures
    for d, theirs, ours in zip(verdict.differences, other, seed0, strict=True):
        assert d.seeds == 1
        assert d.accuracy.mean == pytest.approx(theirs.accuracy.mean - ours.accuracy.mean)
    assert first[0].accuracy.sem is not None


def test_other_seeds_are_not_paired(archive, logs, tmp_path):
    """As many of them, and none in common: what is said of the interval holds."""
    for seed in (6, 7):
        add_net(write_run(tmp_path, experiment="apart", hash="eeee0000", seed=seed), seed)
    verdict = judge([str(logs / "exp"), str(tmp_path / "apart")], archive)
    for d in verdict.differences:
        assert d.seeds == 0
        assert (d.accuracy.sem, d.balanced.sem) == (None, None)
    assert "fewer than two common seeds: the interval is over blocks alone" in text(verdict)


def test_balanced_takes_each_class_alike():
    right = np.array([[1, 1, 1, 1, 1, 1, 0, 0]], dtype=bool)
    labels = np.array([0, 0, 0, 0, 0, 0, 3, 3])
    exact = share(right, labels, np.arange(8), balanced=True)
    # every recall is 0 or 1 in every room
    assert (exact.mean, exact.low, exact.high) == pytest.approx((0.5, 0.5, 0.5))


def test_intervals_cover_and_rooms_widen_them():
    """Rooms are easy or hard as a whole; about 95 % of the intervals hold the truth."""
    rng = np.random.default_rng(0)
    inside, wider = 0, 0
    blocks = np.repeat(np.arange(30), 6)
    for _ in range(400):
        easy = rng.random(30) < 0.5
        p = np.where(easy[blocks], 0.9, 0.3)
        right = rng.random((1, 180)) < p
        labels = rng.integers(0, 3, 180)
        judged = partial(share, right, labels)
        found, alone = judged(blocks), judged(np.arange(180))
        inside += found.low <= 0.6 <= found.high
        wider += found.high - found.low > alone.high - alone.low
    assert 0.9 < inside / 400 < 0.98
    assert wider > 380
