"""Whole runs on the toy problem: seeds, skipping, labels that must stay hidden, errors."""

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
from lightning.pytorch import Callback

from qs3.config import hashing
from qs3.engine import trainer as engine_trainer
from qs3.errors import ConfigError, DataError, MissingDataError, Qs3Error, SelectionError
from qs3.inference.model_file import read_result
from qs3.runs.metrics import Evaluated, Loading, read_metrics
from qs3.training import build as built
from qs3.training.command import train
from qs3.training.settings import CENTRED_ONLY, NOT_TAKEN, UNIT_BALL_ONLY
from qs3.utils.locks import owned
from qs3.utils.version import VERSION, commit
from tests.training.conftest import result_of
from tests.training.toy import toy_config, write_domain


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


def test_one_domain_as_source_and_target(toy, caplog):
    """Is not adaptation, and is said; the upper bound is meant so."""
    same = ("domain@data.source=kinectsim10", "selftraining=none", "protocol.epochs=1")
    train(toy(*same))
    assert "the target's training labels are used" in caplog.text
    caplog.clear()
    metrics = train(toy(*same, "method=supervised"))
    assert "are the same dataset" not in caplog.text
    assert metrics.selection.teacher.startswith("target_train_val, epoch ")
    assert metrics.source == "kinectsim10"


@pytest.mark.parametrize(
    ("more", "where", "value"),
    [
        ("data.val=stratified", ("selection", "validation"), "stratified"),
        ("data.sampler=balanced", ("loading", "sampler"), "balanced"),
        ("data.fps_starts=1", ("loading", "fps_starts"), 1),
        ("data.points=64", ("loading", "fps_starts"), 1),  # all points: nothing to choose
    ],
)
def test_other_loading_is_another_result_and_named(toy, finished, more, where, value):
    cfg = toy(more, "selftraining=none", "protocol.epochs=1")
    metrics = train(cfg)
    assert getattr(getattr(metrics, where[0]), where[1]) == value
    rows = table(hashing.run_folder(cfg) / "history.csv")
    assert rows != table(finished / "history.csv")[: len(rows)]


METRES = ("data.scale=metres", "data.source.unit=metres")


def test_metres_are_another_result_and_named(toy, finished):
    cfg = toy(*METRES, "selftraining=none", "protocol.epochs=1")
    metrics = train(cfg)
    assert metrics.loading.scale == "metres"
    rows = table(hashing.run_folder(cfg) / "history.csv")
    assert rows != table(finished / "history.csv")[: len(rows)]
    unit = toy("selftraining=none", "data.source.unit=metres")  # says something, changes nothing
    assert hashing.config_hash(unit) == hashing.config_hash(toy("selftraining=none"))


def test_the_upper_bound_over_the_floor_asks_only_its_own_domain(toy):
    words = ("method=supervised", "selftraining=none", "protocol.epochs=1")
    cfg = toy(*words, "data.scale=above_floor", "data.target.floor_m=-1")
    assert train(cfg).loading.scale == "above_floor"
    assert read_result(hashing.run_folder(cfg)).floor_m == -1.0
    other = toy(*words, "data.scale=above_floor", "data.target.floor_m=0")
    assert hashing.config_hash(other) != hashing.config_hash(cfg)


def test_the_upper_bound_does_not_ask_for_the_same_source(toy, toy_data, tmp_path):
    data = tmp_path / "data"
    shutil.copytree(toy_data, data)
    words = ("method=supervised", "selftraining=none", "protocol.epochs=1")
    cfg = toy(*words, f"paths.data_dir={data}")
    first = train(cfg)
    assert first.data.source == first.data.target
    shutil.rmtree(data / "specklenet10")
    write_domain(data, "specklenet10", noise=0.06)
    assert train(cfg) == first
    (hashing.run_folder(cfg) / "metrics.json").unlink()
    assert train(cfg).final == first.final


def test_parts_that_cannot_see_metres_are_parts():
    """They are told apart by name, so that no module of theirs is imported to say it."""
    for name in (*UNIT_BALL_ONLY, *CENTRED_ONLY):
        module, _, attribute = name.rpartition(".")
        assert callable(getattr(importlib.import_module(module), attribute))
    cfg = toy_config(Path("."), *METRES)
    cfg.model = {"_target_": "qs3.models.simpleview.simpleview"}
    with pytest.raises(ConfigError, match=r"model=simpleview: its cameras stand 1\.4 from"):
        train(cfg)


def test_the_samples_do_not_lie_under_the_name_of_version_1(toy, tmp_path):
    cache = tmp_path / "cache"
    train(toy("selftraining=none", "protocol.epochs=1", f"paths.cache_dir={cache}"))
    names = sorted(path.name[-12:] for path in cache.glob("*.npy"))
    assert names == ["-32x1-v2.npy", "-32x4-v2.npy", "-32x4-v2.npy"]


# --- errors ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("selftraining.theta=1.5", r"selftraining\.theta must be in \(0, 1\), got 1\.5"),
        ("seed=null", "seed must be a whole number"),
        ("protocol.epochs=0", r"protocol\.epochs"),
        ("protocol.batch_size=1", r"protocol\.batch_size"),
        ("data.points=65", r"data\.points is 65"),
        ("data.val=other", r"data\.val"),
        ("data.sampler=other", r"data\.sampler"),
        ("data.scale=other", r"data\.scale must be one of .*unit_ball.*'other'"),
        ("data.scale=metres", r"domain specklenet10 are not in metres.*data\.source\.unit=metres"),
        ("data.scale=metres data.source.unit=feet", r"specklenet10: unit must be one of"),
        (
            "data.scale=above_floor data.source.unit=metres data.target.floor_m=0",
            r"where the floor is in the clouds of domain specklenet10.*floor_m=-1\.25",
        ),
        (
            "data.scale=above_floor data.source.unit=metres data.source.floor_m=0 "
            "data.target.floor_m=0 method=defrec",
            r"method=defrec: it deforms parts .*; set data\.scale=metres, or choose",
        ),
        (
            "data.scale=above_floor data.source.unit=metres data.source.floor_m=0 "
            "data.target.floor_m=0 method=mlsp",
            r"method=mlsp: it masks parts .*; set data\.scale=metres, or choose",
        ),
        (
            "data.scale=metres data.source.unit=metres data.target.unit=none",
            r"domain kinectsim10 are not in metres",
        ),
        ("data.fps_starts=0", r"data\.fps_starts .* >= 1, got 0"),
        ("evaluation.rotations=-1", r"evaluation\.rotations .* >= 0, got -1"),
        ("num_classes=10", r"num_classes is 10.*set num_classes=3"),
        ("selection.teacher=best", r"selection\.teacher"),
        ("+protocol.epoch=3", r"^protocol\.epoch is no setting.*did you mean protocol\.epochs\?"),
        ("+warmup=3", r"^warmup is no setting, nothing reads it; there are data, model"),
        ("protocol.epochs=abc", r"protocol\.epochs .* got 'abc'"),
        ("protocol.batch_size=0", r"protocol\.batch_size .* got 0"),
        ("protocol.optimizer.lr=abc", r"protocol\.optimizer\.lr must be a number, got 'abc'"),
        ("protocol.optimizer.lr=-1", r"protocol\.optimizer: Invalid learning rate"),
        ("selftraining.theta=abc", r"selftraining\.theta must be a number"),
        ("selftraining.rounds=abc", r"selftraining\.rounds .* got 'abc'"),
        ("data.points=abc", r"data\.points .* got 'abc'"),
        ("trainer.threads=abc", r"trainer\.threads"),
        ("method=supervised", r"method=supervised .* selftraining=none"),
        ("protocol.smoothing=0.7", r"protocol\.smoothing must lie in \[0, 0\.666667\], got 0\.7"),
        ("protocol.smoothing=-0.1", r"protocol\.smoothing must lie in"),
        ("protocol.schedule=step", r"protocol\.schedule must be one of"),
        ("protocol.regulariser=-1", r"protocol\.regulariser must be >= 0"),
        ("evaluation.norms=ada", r"evaluation\.norms must be one of"),
        ("data.clouds_a_class=0", r"data\.clouds_a_class"),
        ("data.clouds_a_split=0", r"data\.clouds_a_split"),
        ("selection.student=best", r"selection\.student must be one of .*'snd'.*'best'"),
        ("objective=accuracy", "objective=accuracy is refused"),
        ("report.pictures=perhaps", r"report\.pictures"),
        ("evaluation=null", "evaluation=null: these are several .* as evaluation.rotations=0"),
        ("report=null", "report=null: .* set report.pictures=false"),
        ("data.sampler=balanced method=supervised", r"=balanced draws source clouds only"),
        ("selection.student=snd", r"selection\.student=snd .*set selection\.student="),
    ],
)
def test_wrong_setting_names_the_key(toy, override, message):
    alone = ["selftraining=none"] if override.startswith(("data.sampler=b", "selection.s")) else []
    with pytest.raises(ConfigError, match=message):
        train(toy(*override.split(), *alone))


@pytest.mark.parametrize(
    ("words", "key"), [("selftraining.init=scratch", "epochs"), ("protocol.steps=2", "steps")]
)
def test_empty_selection(words, key, toy):
    """Says what trains the teacher for longer: with a budget in steps more epochs do not."""
    said = rf"round 0 with theta=0\.9999.*ball 0/0.*lower.*longer \(protocol\.{key}\)"
    with pytest.raises(SelectionError, match=said):
        train(
            toy("selftraining.theta=0.9999", "selftraining.epsilon=0", "protocol.epochs=1", words)
        )


def test_a_student_that_selects_nothing_is_trained_longer_by_its_own_key(toy):
    said = r"round 1 with theta=0\.9\d+.*lower.*longer \(selftraining\.epochs\)"
    with pytest.raises(SelectionError, match=said):
        train(
            toy("selftraining.theta=0.0001", "selftraining.epsilon=0.9998", "selftraining.epochs=1")
        )


@pytest.mark.parametrize("words", ["selftraining.share=null", "selftraining.share=0.5"])
def test_a_diverged_teacher_labels_nothing(toy, words):
    with pytest.raises(SelectionError, match=r"warm-up's net has diverged.*72 of 72 .*lower proto"):
        train(toy("protocol.optimizer.lr=1e30", "protocol.epochs=1", words))


@pytest.mark.parametrize(
    ("train_clouds", "val", "said"),
    [
        ((4, 4, 2), "lineage", "nothing is trained of slab: data.val=lineage holds out all"),
        ((4, 4, 2), "stratified", ""),
        ((8, 8, 0), "stratified", "nothing is trained of slab: it has none"),
    ],
)
def test_classes_that_nothing_teaches_are_named(train_clouds, val, said, toy, tmp_path, caplog):
    """Of one mesh of each of ten classes two were held out, and no accuracy could exceed 0."""
    for name, each in (("specklenet10", train_clouds), ("kinectsim10", 6)):
        write_domain(tmp_path, name, noise=0.1, train=each, test=2)
    words = f"paths.data_dir={tmp_path}", f"data.val={val}", "protocol.epochs=1"
    with caplog.at_level(logging.WARNING):
        train(toy("selftraining=none", *words))
    found = [one.message for one in caplog.records if "nothing is trained" in one.message]
    assert len(found) == bool(said)
    assert all(said in one for one in found)


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
    with pytest.raises(SelectionError, match="no pseudo-label for slab"):
        train(toy("selftraining.missing_class=error"))


def test_missing_data(toy, tmp_path):
    with pytest.raises(MissingDataError, match=r"specklenet10.*\n.*meta\.yaml"):
        train(toy(f"paths.data_dir={tmp_path / 'nowhere'}"))


def test_a_run_that_will_look_at_what_judges_says_so_first(toy, caplog, tmp_path):
    caplog.set_level("INFO")
    words = ("domain@data.target=objects", f"data.target.published.file={tmp_path}/none.npz")
    for more, told in ((["data.target.published.fold=0"], False), ([], True)):
        with pytest.raises(MissingDataError, match=r"none\.npz"):
            train(toy(*words, *more))
        assert ("this looks at what judges, part judge of none.npz" in caplog.text) is told


def test_two_runs_in_one_folder(toy):
    cfg = toy()
    with (
        owned(hashing.run_folder(cfg)),
        pytest.raises(Qs3Error, match="another process is training"),
    ):
        train(cfg)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_gpu_that_is_not_there(toy):
    with pytest.raises(ConfigError, match=r"trainer: .*use trainer=cpu"):
        train(toy("trainer=gpu"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("trainer.limit_train_batches=0", "limit_train_batches must leave a batch, or nothing"),
        ("trainer.limit_val_batches=0.0", "limit_val_batches must leave a batch"),
        (
            "trainer.limit_train_batches=0.01",
            r"trainer: .*0\.01.*at least `limit_train_batches=0\.25",
        ),
        ("trainer.limit_val_batches=0.01", r"trainer: .*0\.01.*at least `limit_val_batches=1\.0"),
        *((f"+trainer.{key}=2", f"{key}=2 cannot be had: .* (set|leave) ") for key in NOT_TAKEN),
    ],
)
def test_what_lightning_cannot_do_for_a_run(toy, words, said):
    """Before a step is taken."""
    cfg = toy("selftraining=none", "protocol.epochs=2", words)
    with pytest.raises(ConfigError, match=said):
        train(cfg)
    assert not (hashing.run_folder(cfg) / "last.ckpt").exists()


def test_other_config_of_the_same_eight_digits_is_refused(toy):
    cfg = toy("selftraining=none", "protocol.epochs=1")
    metrics = train(cfg)
    folder = hashing.run_folder(cfg)
    assert metrics.config_sha256 == hashing.config_sha256(cfg)
    for name in ("metrics.json", "started.json"):
        value = json.loads((folder / name).read_text())
        value["config_sha256"] = value["config_sha256"][:8] + "0" * 56
        (folder / name).write_text(json.dumps(value))
    with pytest.raises(ConfigError, match=r"other settings.*force=true"):
        train(cfg)
    (folder / "metrics.json").unlink()
    with pytest.raises(ConfigError, match=r"other settings.*force=true"):
        train(cfg)


def test_leftovers_of_a_kill_are_removed(toy):
    cfg = toy("selftraining.rounds=1", "protocol.epochs=1", "selftraining.epochs=1")
    folder = hashing.run_folder(cfg)
    leftovers = [folder / ".last.ckpt.x.tmp.ckpt", folder / "round_00" / ".p.csv.x.tmp.csv"]
    for path in leftovers:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
    train(cfg)
    assert not any(path.exists() for path in leftovers)


def test_changed_data_are_refused(toy, toy_data, tmp_path):
    cfg = toy("selftraining=none")
    train(cfg)
    folder = hashing.run_folder(cfg)
    for name in ("metrics.json", "started.json"):
        value = json.loads((folder / name).read_text())
        value["data"]["target"] = "0" * 64
        (folder / name).write_text(json.dumps(value))
    with pytest.raises(DataError, match=r"another version of kinectsim10.*force=true"):
        train(cfg)
    (folder / "metrics.json").unlink()
    with pytest.raises(DataError, match=r"another version of kinectsim10.*force=true"):
        train(cfg)


def test_damaged_checkpoint(toy, tmp_path):
    cfg = toy()
    folder = hashing.run_folder(cfg)
    folder.mkdir(parents=True)
    (folder / "last.ckpt").write_bytes(b"not a checkpoint")
    with pytest.raises(DataError, match=r"last\.ckpt cannot be read.*force=true"):
        train(cfg)


def test_trainings_keep_memory_and_fill_no_tensor_in_vain(toy, tmp_path, monkeypatch):
    """Both are speed alone, so nothing else would notice that they are gone."""
    seen = []

    class Looks(Callback):
        def on_train_start(self, trainer, pl_module):
            seen.append(torch.utils.deterministic.fill_uninitialized_memory)

    monkeypatch.setattr(torch.utils.deterministic, "fill_uninitialized_memory", True)
    monkeypatch.setattr(engine_trainer, "keep_freed_memory", lambda: seen.append("kept"))
    config = toy("selftraining=none", "protocol.epochs=1")
    monkeypatch.setattr(
        built, "build_each", lambda group: [Looks()] if group == config.callbacks else []
    )
    train(config)
    assert seen == ["kept", False]
