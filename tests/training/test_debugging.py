"""debug=overfit and debug=profiler, and `ckpt_path`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from qs3.config import hashing
from qs3.datamodules.splits import subsample_splits
from qs3.engine.classifier import Classifier
from qs3.errors import DataError, MissingDataError, Qs3Error
from qs3.runs.metrics import TrainingAccuracy
from qs3.store.store import open_pointset
from qs3.training.command import train
from qs3.utils.locks import owned
from tests.training.conftest import result_of
from tests.training.toy import write_domain
from tests.training.watching import interrupt


@pytest.mark.slow
def test_overfit_learns_a_few_clouds_by_heart(toy):
    cfg = toy("debug=overfit", "protocol.epochs=100", "selftraining.rounds=0")
    metrics = train(cfg)
    assert metrics.training == TrainingAccuracy(n=12, accuracy=1.0)  # four of each class
    assert metrics.selftraining == "none"
    lr = "protocol.optimizer.lr=1e-9"
    cannot = train(toy("debug=overfit", "protocol.epochs=3", "selftraining.rounds=0", lr))
    assert cannot.training.accuracy < 1
    assert train(toy("selftraining=none")).training is None


@pytest.mark.slow
@pytest.mark.parametrize("profiler", ["SimpleProfiler", "PyTorchProfiler"])
@pytest.mark.filterwarnings("ignore:The PyTorch Profiler default schedule:UserWarning")
def test_profiler_writes_into_the_run(profiler, toy):
    cfg = toy(
        "debug=profiler", "selftraining.rounds=0", "protocol.epochs=2",
        f"trainer.profiler._target_=lightning.pytorch.profilers.{profiler}",
    )  # fmt: skip
    train(cfg)
    text = (hashing.run_folder(cfg) / "fit-profile.txt").read_text()
    own = {"SimpleProfiler": "run_training_epoch", "PyTorchProfiler": "Self CPU time total"}
    assert own[profiler] in text  # not a kernel's name: the twenty dearest rows may have none


def test_few_of_each_split(tmp_path):
    write_domain(tmp_path, "x", noise=0.1, train=24, test=2)  # of each of three classes
    whole = open_pointset(tmp_path / "x")
    few = subsample_splits(whole, 9)
    assert (few.splits == "train").sum() == 9
    assert (few.splits == "test").sum() == 6  # there are no more
    assert few.sha256 == whole.sha256
    assert list(few.counts()["train"].values()) == [3, 3, 3]
    for i, name in enumerate(few.ids):
        at = whole.ids.index(name)
        np.testing.assert_array_equal(few.points[i], whole.points[at])
        assert (few.labels[i], few.splits[i]) == (whole.labels[at], whole.splits[at])
    assert sorted(few.ids, key=whole.ids.index) == list(few.ids)


def test_a_run_of_few_clouds_leaves_no_cache(toy, tmp_path):
    cfg = toy("data.clouds_a_split=12", "selftraining=none", f"data.cache_dir={tmp_path / 'cache'}")
    metrics = train(cfg)
    assert metrics.final.n == 12
    assert metrics.hash != hashing.config_hash(toy("selftraining=none"))
    assert not list((tmp_path / "cache").rglob("*.npy"))
    train(toy("selftraining=none", f"data.cache_dir={tmp_path / 'cache'}"))
    assert list((tmp_path / "cache").rglob("*.npy"))


def test_ckpt_path_last_insists_on_a_checkpoint(toy, finished):
    cfg = toy("ckpt_path=last")
    absent = toy("ckpt_path=last", "data.make_source=true", "paths.data_dir=/nowhere")
    for one in (cfg, absent):  # before the source is made
        with pytest.raises(MissingDataError, match=r"last\.ckpt is not the"):
            train(one)
    assert not (hashing.run_folder(cfg) / "started.json").exists()
    interrupt(toy(), epoch=5)
    train(cfg)
    assert result_of(hashing.run_folder(cfg)) == result_of(finished)
    assert train(toy("ckpt_path=last")).status == "finished"  # nothing is left to do


@pytest.fixture
def begun(toy) -> Path:
    """A run that was interrupted, moved to another place."""
    interrupt(toy(), epoch=6)
    folder = hashing.run_folder(toy())
    moved = folder.parents[1] / "elsewhere" / folder.name
    moved.parent.mkdir()
    shutil.move(folder, moved)
    (moved / ".hydra").mkdir()
    (moved / ".hydra" / "config.yaml").touch()
    return moved


@pytest.mark.slow
@pytest.mark.parametrize("file", ["", "/last.ckpt"])
def test_ckpt_path_brings_a_run_from_elsewhere(file, toy, begun, finished, monkeypatch):
    began: list[int] = []

    def watch(self, real=Classifier.on_train_epoch_start):
        began.append(self.current_epoch)
        real(self)

    monkeypatch.setattr(Classifier, "on_train_epoch_start", watch)
    cfg = toy(f"ckpt_path={begun}{file}", "paths.warmup_dir=null")
    train(cfg)
    assert began[0] == 6  # the one that was not finished there
    assert not (hashing.run_folder(cfg) / ".hydra").exists()
    assert result_of(hashing.run_folder(cfg)) == result_of(finished)
    assert begun.joinpath("last.ckpt").is_file()


def test_ckpt_path_of_another_run(toy, toy_data, begun, tmp_path):
    for other in ("seed=1", "selftraining.theta=0.3"):
        with pytest.raises(MissingDataError, match="not the folder of this run"):
            train(toy(f"ckpt_path={begun}", other))
    with pytest.raises(MissingDataError, match="is not the"):
        train(toy(f"ckpt_path={tmp_path}"))
    with pytest.raises(MissingDataError, match="is not the"):
        train(toy(f"ckpt_path={begun}/warmup_last.pt"))
    data = tmp_path / "other_data"
    shutil.copytree(toy_data, data)
    shutil.rmtree(data / "kinectsim10")
    write_domain(data, "kinectsim10", noise=0.2)
    with pytest.raises(DataError, match=r"another version of data\.target"):
        train(toy(f"ckpt_path={begun}", f"paths.data_dir={data}", f"paths.log_dir={tmp_path}/new"))
    (begun / "started.json").unlink()
    with pytest.raises(MissingDataError, match="not the folder of this run"):
        train(toy(f"ckpt_path={begun}"))


def test_a_checkpoint_with_a_flipped_bit_is_refused(toy, begun):
    data = bytearray((begun / "last.ckpt").read_bytes())
    data[len(data) // 2] ^= 1
    (begun / "last.ckpt").write_bytes(data)
    alone = "paths.warmup_dir=null"
    with pytest.raises(DataError, match=r"last\.ckpt cannot be read .*checksum.*copy it again"):
        train(toy(f"ckpt_path={begun}", alone))
    own = hashing.run_folder(toy(alone)) / "last.ckpt"
    assert not own.exists()
    shutil.copy(begun / "last.ckpt", own)
    with pytest.raises(DataError, match=r"last\.ckpt cannot be read .*checksum.*force=true"):
        train(toy(alone))


def test_ckpt_path_of_a_run_that_is_being_trained(toy, begun):
    with owned(begun), pytest.raises(Qs3Error, match="another process is training in"):
        train(toy(f"ckpt_path={begun}", "paths.warmup_dir=null"))


def change_started(folder, **changes) -> None:
    """`started.json` of a run that other software began."""
    file = folder / "started.json"
    document = json.loads(file.read_text())
    for key, value in changes.items():
        (document["versions"] if key == "torch" else document)[key] = value
    file.write_text(json.dumps(document))


@pytest.mark.slow
def test_ckpt_path_warns_of_other_versions(toy, begun, caplog):
    change_started(begun, torch="1.0", threads=77)
    cfg = toy(f"ckpt_path={begun}", "paths.warmup_dir=null")
    interrupt(cfg, epoch=7)
    assert "begun with torch 1.0, threads 77, continued with torch" in caplog.text
    caplog.clear()
    metrics = train(cfg)  # whose own checkpoint it goes on from: still that of both
    assert "begun with torch 1.0, threads 77, continued with" in caplog.text
    assert metrics.versions["torch"] == "1.0"


@pytest.mark.parametrize(
    "changed", [{}, {"torch": "1.0"}, {"threads": 77}, {"files": {"qs3's code": "0" * 64}}]
)
def test_a_warm_up_of_two_versions_is_given_to_nobody(toy, changed, tmp_path, caplog):
    cfg = toy(f"paths.warmup_dir={tmp_path / 'warmups'}")
    interrupt(cfg, epoch=2)
    change_started(hashing.run_folder(cfg), **changed)
    train(cfg)
    assert ("begun with" in caplog.text) == bool(changed)
    assert (tmp_path / "warmups").exists() == (not changed)


def test_a_run_without_a_checkpoint_begins_with_what_there_is(toy, caplog):
    cfg = toy()
    interrupt(cfg, epoch=0)
    change_started(hashing.run_folder(cfg), torch="1.0")
    metrics = train(cfg)
    assert "begun with" not in caplog.text
    assert metrics.versions["torch"] == torch.__version__
