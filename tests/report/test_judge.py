"""Runs judged on an archive: by hand, by family and by tier."""

import csv

import numpy as np
import pytest
import torch

from qs3.classes import CLASSES
from qs3.datasets.object_archive import read_archive
from qs3.errors import ConfigError, MissingDataError
from qs3.inference.model_file import Result, write_result
from qs3.inference.predictor import load
from qs3.models.pointnet import pointnet
from qs3.report.judge import find_runs, judge, text
from tests.fixtures.frame_files import write_archive
from tests.report.made_runs import write_run
from tests.running import main


def add_net(folder, seed, *, classes=CLASSES, **changes):
    """A run's result.pt of an untrained net; its last bias makes it name several classes."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        net = pointnet(num_classes=len(classes), variant="basic")
    model = {"_target_": "qs3.models.pointnet.pointnet", "variant": "basic"}
    values = {
        "model": {**model, "num_classes": len(classes)},
        "classes": tuple(classes), "points": 32, "stored_points": 128, "target": "kinectsim10",
        "gravity": "z", "scale": "unit_ball", "usual": {}, "weights": net.state_dict(),
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
    everything, *tiers = (row for _, row in verdict.figures.iterrows())
    assert (everything.run, everything.seeds) == ("exp 0123abcd", "0 1")
    assert "part judge" in verdict.about
    held = read_archive(archive)
    kept = np.flatnonzero(held.dev == "judge")
    truth = np.array([CLASSES.index(name) for name in held.cls[kept]])
    nets = map(load, find_runs([str(logs / "exp")]))
    right = np.stack([net([held.cloud(i) for i in kept]).argmax(1) == truth for net in nets])
    assert (everything.objects, everything.majority) == (50, 0.1)
    assert everything.accuracy == pytest.approx(right.mean())
    per_seed = right.mean(axis=1)
    assert everything.accuracy_sem == pytest.approx(per_seed.std(ddof=1) / np.sqrt(2))
    for tier in tiers:
        mine = held.tier[kept] == tier.tier
        assert tier.objects == mine.sum()
        assert tier.accuracy == pytest.approx(right[:, mine].mean())
        recalls = [right[:, mine & (truth == k)].mean() for k in np.unique(truth[mine])]
        assert tier.balanced == pytest.approx(np.mean(recalls))
    assert sum(tier.objects for tier in tiers) == everything.objects


def test_classes_of_one_block_are_named(archive, logs, tmp_path):
    """Their recalls add nothing to the interval, which is too narrow then."""
    assert "one block alone" not in text(judge([str(logs / "other")], archive))
    arrays = dict(np.load(archive))
    beds = np.flatnonzero((arrays["cls"] == "bed") & (arrays["dev"] == "judge"))
    arrays["cls"][beds[1:]] = "sofa"
    np.savez(tmp_path / "held_back.npz", **arrays)
    verdict = judge([str(logs / "other")], tmp_path / "held_back.npz")
    assert verdict.figures.alone.tolist() == ["bed", "bed", ""]
    assert "(!) bed (all) lie in one block alone" in text(verdict)


def test_other_rows_are_compared_with_the_first(archive, logs, tmp_path):
    both = judge([str(logs / "exp"), str(logs / "other")], archive).figures
    seed0 = judge([str(logs / "exp" / "seed0-0123abcd")], archive).figures
    less = both.accuracy[3:].to_numpy() - seed0.accuracy.to_numpy()  # of the seed that both have
    assert both.accuracy_more[3:].tolist() == pytest.approx(less.tolist())
    assert np.isnan(both.accuracy_more[:3]).all()
    for seed in (6, 7):  # as many seeds, and none in common
        add_net(write_run(tmp_path, experiment="apart", hash="eeee0000", seed=seed), seed)
    verdict = judge([str(logs / "exp"), str(tmp_path / "apart")], archive)
    assert np.isnan(verdict.figures.accuracy_more_sem[3:].astype(float)).all()


def test_runs_of_other_classes_and_of_heights(archive, logs, tmp_path):
    with pytest.raises(ConfigError, match="adapt, gap, judge"):
        judge([str(logs)], archive, part="x")
    few = add_net(tmp_path, 3, classes=("sofa", "chair", "bed"))
    verdict = judge([str(logs / "other"), str(few)], archive)
    assert verdict.classes == ("bed", "chair", "sofa")
    assert verdict.figures.run[3] == str(few / "result.pt")
    standing = add_net(tmp_path, 3, scale="above_floor", floor_m=0.0)
    with pytest.raises(ConfigError, match="floor"):
        judge([str(standing)], archive)
    low, high = (judge([str(standing)], archive, floor=floor) for floor in (-1.2, -25.0))
    assert not low.figures.drop(columns="alone").equals(high.figures.drop(columns="alone"))
    camera = add_net(tmp_path, 3, gravity="none")
    with pytest.raises(ConfigError, match="their camera's frame"):
        judge([str(camera)], archive)


def test_runs_are_found(archive, logs, tmp_path):
    assert len(find_runs([str(logs)])) == 3
    assert len(find_runs([f"{logs}/exp/seed0-0123abcd", str(logs / "exp")])) == 2
    files = find_runs(["dgcnn-rooms", str(add_net(tmp_path, 0))])
    assert [file.name for file in files] == ["model.safetensors", "result.pt"]
    (tmp_path / "empty").mkdir()
    for words in (tmp_path / "nothing", tmp_path / "empty"):
        with pytest.raises(MissingDataError):
            find_runs([str(words)])
    again = write_run(tmp_path / "again", experiment="other", hash="ffff0000")
    add_net(again, 5)
    with pytest.raises(ConfigError, match="twice"):
        judge([str(logs / "other"), str(again)], archive)


def test_the_command(archive, logs, tmp_path, capsys):
    words = ["report", "judge", f"runs={logs / 'exp'}", f"data={archive}"]
    assert main([*words, f"out={tmp_path}/judged.csv"]) == 0
    assert "exp 0123abcd" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "judged.csv").read_text().splitlines()))
    assert [row["tier"] for row in rows] == ["all", "clean", "hard"]
    assert rows[0]["objects_chair"] == "5"
