"""Whole runs on the toy problem: seeds, skipping, force, labels that must stay hidden, errors."""

from __future__ import annotations

import csv
import importlib
import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from qs3.config.hydra import config_sha256, run_folder
from qs3.errors import ConfigError, DataError, MissingDataError, Qs3Error, SelectionError
from qs3.runs.metrics import Evaluated, Loading, read_metrics
from qs3.training.command import train
from qs3.training.run import SCALES
from qs3.utils.files import owned
from qs3.utils.version import VERSION, commit
from tests.training.conftest import result_of
from tests.training.watching import interrupt


def table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def test_metrics_and_files(finished):
    metrics = read_metrics(finished)
    assert metrics is not None
    assert metrics.status == "finished"
    assert (metrics.source, metrics.target) == ("specklenet10", "kinectsim10")
    assert metrics.versions["qs3"] == VERSION
    assert metrics.versions.get("commit", "").rstrip("+") == commit().rstrip("+")
    assert metrics.simulated is True
    assert metrics.selection.student == "last"
    assert metrics.selection.teacher.startswith("source_val, epoch ")
    assert [r.round for r in metrics.rounds] == [0, 1]
    assert [r.theta for r in metrics.rounds] == [0.4, 0.405]
    assert metrics.final.n == 24
    assert metrics.final.majority_rate == pytest.approx(1 / 3)
    rows = table(finished / "history.csv")
    assert [int(row["epoch"]) for row in rows] == list(range(7))
    assert [int(row["phase"]) for row in rows] == [0] * 3 + [1] * 2 + [2] * 2
    assert metrics.final.accuracy > 0.6  # it learns
    assert 0 <= metrics.final.calibration_error <= 1
    assert metrics.loading == Loading(
        points=32, scale="unit_ball", fps_starts=4, sampler="shuffled"
    )
    assert metrics.evaluation == Evaluated(split="test", labels=True, norms="trained")
    rows = table(finished / "round_00" / "pseudo_labels.csv")
    kept = [row for row in rows if row["selected"] == "1"]
    assert (len(rows), len(kept)) == (72, metrics.rounds[0].total_selected)
    assert all(float(row["confidence"]) > 0.4 for row in kept)


@pytest.mark.slow
def test_seed_1_alone_equals_seed_1_after_seed_0(toy, toy_data, tmp_path):
    for seed in (0, 1):  # as the basic launcher does: one process
        torch.manual_seed(123)
        train(toy(f"seed={seed}"))
    after = result_of(run_folder(toy("seed=1")))
    alone = toy("seed=1", f"paths.log_dir={tmp_path / 'alone'}")
    torch.rand(7)
    np.random.rand(3)  # noqa: NPY002 (disturbs the global state on purpose)
    train(alone)
    assert result_of(run_folder(alone)) == after
    zero = result_of(run_folder(toy("seed=0")))
    assert zero["history.csv"] != after["history.csv"]


def test_finished_run_is_skipped_and_force_repeats_it(toy, monkeypatch):
    words = ("selftraining=none", "method=source_only", "protocol.epochs=1")
    cfg = toy(*words)
    first = train(cfg)
    folder = run_folder(cfg)
    stamp = (folder / "last.ckpt").stat().st_mtime_ns
    assert train(cfg) == first
    assert (folder / "last.ckpt").stat().st_mtime_ns == stamp
    again = train(toy(*words, "force=true"))
    assert (folder / "last.ckpt").stat().st_mtime_ns != stamp
    assert replace(again, times=first.times) == first


def test_without_self_training_the_selected_warmup_is_reported(toy, finished):
    """And it is the same warm-up: a table's row of PCM can be read off the run of PCM + QBST."""
    metrics = train(toy("selftraining=none"))
    assert metrics.warmup == read_metrics(finished).warmup
    assert metrics.rounds == []
    assert metrics.selection.student == metrics.selection.teacher
    assert metrics.final == metrics.warmup.selected.scores


# --- errors ----------------------------------------------------------------------------------


WRONG = (
    "seed=null", "seed=-1", "protocol.epochs=0", "protocol.epochs=abc", "protocol.batch_size=1",
    "protocol.smoothing=1", "protocol.schedule=step", "protocol.regulariser=-1", "+warmup=3",
    "+protocol.epoch=3", "data.points=65", "selection.teacher=best", "selection.teacher=given",
    "evaluation.norms=ada",
    "evaluation.prior_power=-1", "evaluation=null", "force=no", "objective=accuracy",
    "experiment_name=a/b", "experiment_name=..", "num_classes=10", "selftraining.theta=1.5",
    "selftraining.rounds=abc", "protocol.augment.crop=2", "data.scale=metres",
)  # fmt: skip


@pytest.mark.parametrize("word", WRONG)
def test_wrong_settings_are_refused_before_training(toy, word):
    key = word.lstrip("+").partition("=")[0].rpartition(".")[2]
    cfg = toy("selftraining.rounds=1", word)
    with pytest.raises((ConfigError, DataError), match="unit" if key == "scale" else key):
        train(cfg)


@pytest.mark.parametrize("part", SCALES)
def test_parts_that_cannot_see_a_scale_refuse_it(toy, part):
    module, _, attribute = part.rpartition(".")
    assert callable(getattr(importlib.import_module(module), attribute))
    group = "model" if "models" in part else "method"
    cfg = toy("data.scale=above_floor")
    cfg[group] = {"_target_": part}
    with pytest.raises(ConfigError, match=attribute):
        train(cfg)


def test_empty_selection(toy):
    words = ("selftraining.theta=0.9999", "selftraining.epsilon=0", "protocol.epochs=1")
    with pytest.raises(SelectionError, match="round 0"):
        train(toy(*words))


def test_a_run_without_epochs_left_is_not_finished(toy):
    """Such as where nothing is trained in an epoch."""
    cfg = toy("selftraining=none", "trainer.limit_train_batches=0")
    with pytest.raises(ConfigError):
        train(cfg)
    assert not (run_folder(cfg) / "metrics.json").exists()


def test_missing_class_is_logged_and_recorded(toy, caplog, monkeypatch):
    def only_two(net, points, batch_size, device="cpu"):
        table = np.full((len(points), 3), 0.02)
        table[np.arange(len(points)), np.arange(len(points)) % 2] = 0.96
        return table

    monkeypatch.setattr("qs3.selftraining.callback.predict", only_two)
    words = ("protocol.epochs=1", "selftraining.rounds=1")
    with caplog.at_level(logging.WARNING):
        metrics = train(toy(*words))
    assert "no pseudo-label for slab" in caplog.text
    assert metrics.rounds[0].missing_classes == ["slab"]


def test_two_runs_in_one_folder(toy):
    cfg = toy()
    with (
        owned(run_folder(cfg)),
        pytest.raises(Qs3Error, match="another process is training"),
    ):
        train(cfg)


def test_other_settings_of_the_same_name_and_changed_data_are_refused(toy):
    cfg = toy("selftraining=none", "protocol.epochs=1")
    metrics = train(cfg)
    folder = run_folder(cfg)
    assert metrics.config_sha256 == config_sha256(cfg)
    files = {name: (folder / name).read_text() for name in ("metrics.json", "started.json")}
    for place, error in (("config_sha256",), ConfigError), (("data", "target"), DataError):
        for name, text in files.items():
            value = json.loads(text)
            inner = value
            for key in place[:-1]:
                inner = inner[key]
            inner[place[-1]] = inner[place[-1]][:8] + "0" * 56
            (folder / name).write_text(json.dumps(value))
        with pytest.raises(error):
            train(cfg)
        (folder / "metrics.json").unlink()
        with pytest.raises(error):
            train(cfg)


def without(data: Path) -> None:
    shutil.rmtree(data)


def damaged(data: Path) -> None:
    (data / "kinectsim10" / "points.npy").write_bytes(b"")


@pytest.mark.parametrize("ruin", [without, damaged])
def test_an_old_result_stays_where_its_data_cannot_be_opened(toy, toy_data, tmp_path, ruin):
    """Such as of a mistyped folder: where data lie is no part of a run's name."""
    folder = run_folder(toy())
    for name in ("metrics.json", "result.pt", "round_00/pseudo_labels.csv"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    shutil.copytree(toy_data, tmp_path / "data")
    ruin(tmp_path / "data")
    with pytest.raises(MissingDataError if ruin is without else DataError):
        train(toy(f"paths.data_dir={tmp_path / 'data'}", "force=true"))
    for name in ("metrics.json", "result.pt", "round_00/pseudo_labels.csv"):
        assert (folder / name).read_text() == name


def test_a_run_of_few_clouds_leaves_no_cache(toy, tmp_path):
    words = ("data.clouds_a_split=12", "selftraining=none", "protocol.epochs=1")
    metrics = train(toy(*words, f"data.cache_dir={tmp_path / 'cache'}"))
    assert metrics.final.n == 12
    assert not list((tmp_path / "cache").rglob("*.npy"))


def change_started(folder, **changes) -> None:
    """`started.json` of a run that other software began."""
    file = folder / "started.json"
    document = json.loads(file.read_text())
    for key, value in changes.items():
        (document["versions"] if key == "torch" else document)[key] = value
    file.write_text(json.dumps(document))


def test_a_run_that_other_software_began_warns(toy, finished, caplog):
    cfg = toy("paths.warmup_dir=null")
    interrupt(cfg, epoch=4)
    change_started(run_folder(cfg), torch="1.0", threads=77)
    metrics = train(cfg)
    assert "begun with torch 1.0, threads 77, continued with torch" in caplog.text
    assert metrics.versions["torch"] == "1.0"
    ours, theirs = result_of(run_folder(cfg)), result_of(finished)
    for result in (ours, theirs):
        del result["metrics"]["versions"]
    assert ours == theirs


def test_a_checkpoint_with_a_flipped_bit_is_refused(toy):
    cfg = toy("paths.warmup_dir=null")
    interrupt(cfg, epoch=1)
    own = run_folder(cfg) / "last.ckpt"
    data = bytearray(own.read_bytes())
    weights = max(torch.load(own)["state_dict"].values(), key=torch.numel)
    data[data.index(weights.numpy().tobytes())] ^= 1  # not a byte between two tensors
    own.write_bytes(data)
    with pytest.raises(DataError, match=r"last\.ckpt"):
        train(cfg)


@pytest.mark.parametrize("changed", [{}, {"torch": "1.0"}, {"files": {"qs3's code": "0" * 64}}])
def test_a_warm_up_of_two_versions_is_given_to_nobody(toy, changed, tmp_path, caplog):
    cfg = toy("selftraining=none", f"paths.warmup_dir={tmp_path / 'warmups'}")
    interrupt(cfg, epoch=1)
    change_started(run_folder(cfg), **changed)
    train(cfg)
    assert ("begun with" in caplog.text) == bool(changed)
    assert (tmp_path / "warmups").exists() == (not changed)
