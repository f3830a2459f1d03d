"""Whole runs on the toy problem: seeds, skipping, labels that must stay hidden, errors."""

from __future__ import annotations

import csv
import importlib
import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from qs3.config import hashing
from qs3.errors import ConfigError, DataError, Qs3Error, SelectionError
from qs3.runs.metrics import Evaluated, Loading, read_metrics
from qs3.training.command import train
from qs3.training.run import SCALES
from qs3.utils.locks import owned
from qs3.utils.version import VERSION, commit
from tests.training.conftest import result_of


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
    assert [int(row["epoch"]) for row in rows] == list(range(10))
    assert [int(row["phase"]) for row in rows] == [0] * 4 + [1] * 3 + [2] * 3
    assert metrics.final.accuracy > 0.6  # it learns
    assert 0 <= metrics.final.calibration_error <= 1
    assert metrics.loading == Loading(
        points=32, scale="unit_ball", fps_starts=4, sampler="shuffled"
    )
    assert metrics.selection.validation == "lineage"
    assert metrics.evaluation == Evaluated(split="test", labels=True, rotations=0, norms="trained")
    rows = table(finished / "round_00" / "pseudo_labels.csv")
    kept = [row for row in rows if row["selected"] == "1"]
    assert (len(rows), len(kept)) == (72, metrics.rounds[0].total_selected)
    assert all(float(row["confidence"]) > 0.4 for row in kept)


@pytest.mark.slow
def test_seed_1_alone_equals_seed_1_after_seed_0(toy, toy_data, tmp_path):
    for seed in (0, 1):  # as the basic launcher does: one process
        torch.manual_seed(123)
        train(toy(f"seed={seed}"))
    after = result_of(hashing.run_folder(toy("seed=1")))
    alone = toy("seed=1", f"paths.log_dir={tmp_path / 'alone'}")
    torch.rand(7)
    np.random.rand(3)  # noqa: NPY002 (disturbs the global state on purpose)
    train(alone)
    assert result_of(hashing.run_folder(alone)) == after
    zero = result_of(hashing.run_folder(toy("seed=0")))
    assert zero["history.csv"] != after["history.csv"]


def test_finished_run_is_skipped_and_force_repeats_it(toy, monkeypatch):
    cfg = toy("selftraining=none", "method=source_only")
    first = train(cfg)
    folder = hashing.run_folder(cfg)
    stamp = (folder / "last.ckpt").stat().st_mtime_ns
    assert train(cfg) == first
    assert (folder / "last.ckpt").stat().st_mtime_ns == stamp
    again = train(toy("selftraining=none", "method=source_only", "force=true"))
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
    "selection.student=best", "evaluation.norms=ada", "evaluation.rotations=-1",
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
    assert not (hashing.run_folder(cfg) / "metrics.json").exists()


def test_missing_class_is_logged_and_recorded(toy, caplog, monkeypatch):
    def only_two(net, points, batch_size, device="cpu"):
        table = np.full((len(points), 3), 0.02)
        table[np.arange(len(points)), np.arange(len(points)) % 2] = 0.96
        return table

    monkeypatch.setattr("qs3.selftraining.callback.predict", only_two)
    with caplog.at_level(logging.WARNING):
        metrics = train(toy())
    assert "no pseudo-label for slab" in caplog.text
    assert metrics.rounds[0].missing_classes == ["slab"]
    with pytest.raises(SelectionError, match="slab"):
        train(toy("selftraining.missing_class=error"))


def test_two_runs_in_one_folder(toy):
    cfg = toy()
    with (
        owned(hashing.run_folder(cfg)),
        pytest.raises(Qs3Error, match="another process is training"),
    ):
        train(cfg)


@pytest.mark.parametrize(
    ("place", "error"), [(("config_sha256",), ConfigError), (("data", "target"), DataError)]
)
def test_other_settings_of_the_same_name_and_changed_data_are_refused(toy, place, error):
    cfg = toy("selftraining=none", "protocol.epochs=1")
    metrics = train(cfg)
    folder = hashing.run_folder(cfg)
    assert metrics.config_sha256 == hashing.config_sha256(cfg)
    for name in ("metrics.json", "started.json"):
        value = json.loads((folder / name).read_text())
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
