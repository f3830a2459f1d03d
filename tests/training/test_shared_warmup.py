"""A warm-up trained by another run gives the same result, to the bit, as one's own."""

from __future__ import annotations

import json
import logging
import os
import shutil
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from omegaconf import OmegaConf

from qs3.config import hashing
from qs3.engine.checkpointing import SaveLast
from qs3.runs.checkpoints import load
from qs3.runs.metrics import read_metrics
from qs3.training import resume
from qs3.training.command import train
from qs3.training.resume import SharedWarmup, warmup_sha256
from qs3.utils.files import copy_file, sha256_file
from tests.training.conftest import result_of


@pytest.fixture(autouse=True)
def _all_messages(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)


def taken(caplog: pytest.LogCaptureFixture) -> bool:
    return "the warm-up was trained before" in caplog.text


def flipped(data: bytes) -> bytes:
    """One bit in the middle is another."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


# Lightning asks torch for what torch gives up; nothing here is on a GPU or in several processes.
pytestmark = [
    pytest.mark.filterwarnings("ignore:.*LeafSpec.* is deprecated:FutureWarning"),
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
]
SHA256 = "0123456789abcdef" * 4


class Epochs(Callback):
    """The history of a run: the epochs that are over."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "history.csv"

    def on_train_epoch_end(self, trainer, pl_module):
        with self.file.open("a") as file:
            file.write(f"{trainer.current_epoch}\n")


class Quick(LightningModule):
    """One weight, one step an epoch."""

    def __init__(self):
        super().__init__()
        self.net = torch.nn.Linear(1, 1)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)

    def training_step(self, batch, i):
        return self.net(batch).sum()


def trained(folder: Path, shared: SharedWarmup, epochs: int = 6) -> None:
    """A run of some net, with the callbacks in the order of `fit`."""
    folder.mkdir(exist_ok=True)
    callbacks = [Epochs(folder), SaveLast(folder), shared]
    quiet = dict.fromkeys(("logger", "enable_progress_bar", "enable_model_summary"), False)
    Trainer(
        max_epochs=epochs,
        callbacks=callbacks,
        accelerator="cpu",
        default_root_dir=folder,
        log_every_n_steps=1,
        **quiet,
    ).fit(Quick(), torch.utils.data.DataLoader(torch.ones(1, 1)))


@pytest.mark.parametrize("warmup", [1, 2, 3, 5, 6])
def test_it_is_shared_one_epoch_before_its_end_and_once(tmp_path, warmup, caplog):
    (tmp_path / "b").mkdir()
    where = tmp_path / "warmups" / "01234567-seed7"
    trained(tmp_path / "a", SharedWarmup(tmp_path / "a", where.parent, SHA256, 7, warmup))
    other = SharedWarmup(tmp_path / "b", where.parent, SHA256, 7, warmup)
    if warmup == 1:
        assert not where.exists()
        assert not other.take()
        return
    assert (where / "history.csv").read_text().split() == [str(i) for i in range(warmup - 1)]
    files = {name: sha256_file(where / name) for name in ("history.csv", "last.ckpt")}
    mark = {"warmup_sha256": SHA256, "files": files}
    assert json.loads((where / "started.json").read_text()) == mark
    assert load(where / "last.ckpt")["epoch"] == warmup - 2
    assert other.take()
    assert f"going on from {where}" in caplog.text
    for name in files:
        assert (tmp_path / "b" / name).read_bytes() == (where / name).read_bytes()
    assert not other.take()  # it has begun
    changed = where.stat().st_mtime_ns, (where / "last.ckpt").stat().st_mtime_ns
    trained(tmp_path / "c", SharedWarmup(tmp_path / "c", where.parent, SHA256, 7, warmup))
    assert (where.stat().st_mtime_ns, (where / "last.ckpt").stat().st_mtime_ns) == changed


def test_what_a_copy_that_was_killed_left_is_cleared(tmp_path):
    where = tmp_path / "warmups" / "01234567-seed7"
    where.mkdir(parents=True)
    (where / ".last.ckpt.abc.tmp.ckpt").write_text("half")
    trained(tmp_path / "a", SharedWarmup(tmp_path / "a", where.parent, SHA256, 7, 3))
    assert sorted(path.name for path in where.glob("*.ckpt")) == ["last.ckpt"]


@pytest.mark.parametrize("different", ["sha256", "seed", "nothing is shared"])
def test_nobody_elses_is_taken(tmp_path, different, caplog):
    (tmp_path / "b").mkdir()
    warmups = tmp_path / "warmups"
    trained(tmp_path / "a", SharedWarmup(tmp_path / "a", warmups, SHA256, 7, 3), epochs=3)
    given = {
        "sha256": (warmups, SHA256[:-1] + "0", 7, 3),  # of the same name
        "seed": (warmups, SHA256, 8, 3),
        "nothing is shared": (None, SHA256, 7, 3),
    }[different]
    mine = SharedWarmup(tmp_path / "b", *given)
    assert not mine.take()
    assert not any((tmp_path / "b").iterdir())
    assert ("is damaged" in caplog.text) == (different == "sha256")
    trained(tmp_path / "b", mine, epochs=3)
    assert len(list(warmups.iterdir())) == (2 if different == "seed" else 1)
    assert mine.take() is False


def started(folder: Path) -> Path:
    """The folder of a run that is one epoch away from its warm-up's end; no two are alike."""
    folder.mkdir()
    for name in ("history.csv", "last.ckpt"):
        (folder / name).write_text(f"{name} of {folder.name}")
    return folder


def give(warmups: Path, folder: Path) -> None:
    over = SimpleNamespace(current_epoch=0, is_global_zero=True)
    SharedWarmup(folder, warmups, SHA256, 7, 2).on_train_epoch_end(over, None)


def test_runs_that_start_together_share_one(tmp_path, caplog, monkeypatch):
    """Others come while the first one's files are there and their mark is not."""
    warmups, second = tmp_path / "warmups", started(tmp_path / "second")
    (tmp_path / "third").mkdir()
    third = SharedWarmup(tmp_path / "third", warmups, SHA256, 7, 2)
    found, threads = [], []

    def come_meanwhile(source: Path, target: Path) -> None:
        copy_file(source, target)
        if source.name == "last.ckpt" and not threads:
            jobs = (lambda: give(warmups, second)), (lambda: found.append(third.take()))
            threads.extend(threading.Thread(target=job) for job in jobs)
            for thread in threads:
                thread.start()
                thread.join(0.2)

    monkeypatch.setattr(resume, "copy_file", come_meanwhile)
    give(warmups, started(tmp_path / "first"))
    for thread in threads:
        thread.join()
    assert found == [True]  # it waited for the mark
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    assert (tmp_path / "third" / "last.ckpt").read_text() == "last.ckpt of first"
    (tmp_path / "fourth").mkdir()
    assert SharedWarmup(tmp_path / "fourth", warmups, SHA256, 7, 2).take()


def test_one_killed_while_it_replaces_a_damaged_one_leaves_none(tmp_path, caplog, monkeypatch):
    warmups = tmp_path / "warmups"
    give(warmups, started(tmp_path / "first"))
    (where,) = warmups.iterdir()
    (where / "last.ckpt").write_text("damaged")

    def killed(source: Path, target: Path) -> None:
        raise SystemExit

    with monkeypatch.context() as during:
        during.setattr(resume, "copy_file", killed)
        with pytest.raises(SystemExit):
            give(warmups, started(tmp_path / "second"))
    (tmp_path / "third").mkdir()
    third = SharedWarmup(tmp_path / "third", warmups, SHA256, 7, 2)
    assert not third.take()
    assert "is damaged" not in caplog.text
    give(warmups, started(tmp_path / "fourth"))
    assert third.take()


def test_where_one_may_not_write_one_may_take(tmp_path, monkeypatch):
    warmups = tmp_path / "warmups"
    give(warmups, started(tmp_path / "first"))
    (where,) = warmups.iterdir()
    (where / ".lock").unlink()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != where)
    (tmp_path / "second").mkdir()
    assert SharedWarmup(tmp_path / "second", warmups, SHA256, 7, 2).take()
    assert not (where / ".lock").exists()


def test_the_hash_covers_what_comes_before():
    plain = {
        "paths": {"scratch": "a"},
        "model": {"k": 20, "notes": "${paths.scratch}"},
        "selection": {"teacher": "last", "student": "last"},
        "selftraining": {"rounds": 3},
        "evaluation": {"turns": 4},
        "experiment_name": "a",
    }
    started = {"data": {"source": {"sha256": "a"}, "target": 1}, "versions": {"a": 1, "b": 2}}
    started |= {"threads": 1, "files": {}}

    def of(key="", value=None, started=started):
        cfg = OmegaConf.create(plain)
        if key:
            OmegaConf.update(cfg, key, value)
        return warmup_sha256(cfg, started)

    for key, value in (
        ("paths.scratch", "b"),
        ("selection.student", "best"),
        ("selftraining.rounds", 4),
        ("evaluation", None),
        ("experiment_name", "b"),
    ):
        assert of(key, value) == of(), key
    turned = {"versions": {"b": 2, "a": 1}, "data": {"target": 1, "source": {"sha256": "a"}}}
    assert of(started={**started, **turned}) == of()
    others = [
        of("model.k", 10),
        of("selection.teacher", "best"),
        of(started={**started, "threads": 2}),
        of(started={**started, "versions": {"a": 1, "b": 3}}),
        of(started={**started, "data": {"source": {"sha256": "b"}, "target": 1}}),
    ]
    assert len({of(), *others}) == 6


@pytest.mark.parametrize(
    "key", ["selftraining.rounds", "selection.student", "evaluation.turns", "experiment_name"]
)
@pytest.mark.parametrize("before", ["${", "${..", "a ${oc.select:"])
def test_what_comes_from_later_settings_counts_by_its_value(key, before):
    def of(interpolation, **values):
        plain = {"protocol": {"a": interpolation, "b": "${data.evaluation}"}}
        cfg = OmegaConf.create({**plain, "data": {"evaluation": 1}})
        for place in (key, "selection.teacher"):
            OmegaConf.update(cfg, place, values.get(place, 1))
        return warmup_sha256(cfg, {"data": 1, "versions": 2, "threads": 1, "files": {}})

    assert of("x") == of("x", **{key: 2})
    written = f"{before}{key}}}"
    assert of(written) != of(written, **{key: 2})
    if before == "${":
        assert of(written) == of(1)
    assert of("${selection.teacher}") != of(1)  # as it is written


def shared_folders(folder: Path) -> list[Path]:
    return sorted((folder / "logs" / "warmups").glob("*"))


@pytest.mark.parametrize(
    "selftraining", ["qbst", *(pytest.param(n, marks=pytest.mark.slow) for n in ("spst", "cbst"))]
)
def test_same_result_to_the_bit(toy, tmp_path, caplog, selftraining):
    more = [f"selftraining={selftraining}", "selftraining.missing_class=warn"]
    alone = toy(*more, "paths.warmup_dir=null")
    train(alone)
    expected = result_of(hashing.run_folder(alone))
    weights = load(hashing.run_folder(alone) / "student.pt")
    shutil.rmtree(hashing.run_folder(alone))
    assert not shared_folders(tmp_path)

    train(toy("selftraining=none", "experiment_name=other"))
    assert len(shared_folders(tmp_path)) == 1
    assert not taken(caplog)
    train(toy(*more))
    assert taken(caplog)
    assert result_of(hashing.run_folder(alone)) == expected
    again = load(hashing.run_folder(alone) / "student.pt")
    assert all(torch.equal(weights[name], again[name]) for name in weights)


@pytest.mark.slow
def test_a_flipped_bit_is_trained_again(toy, tmp_path, caplog):
    train(toy("selftraining=none"))
    (folder,) = shared_folders(tmp_path)
    sha256 = json.loads((folder / "started.json").read_text())["warmup_sha256"]

    def take(name: str) -> bool:
        return SharedWarmup(tmp_path / name, folder.parent, sha256, 0, 2).take()

    assert take("whole")
    for name in ("history.csv", "last.ckpt"):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(flipped(whole))
        caplog.clear()
        assert not take(name)
        assert f"the warm-up in {folder} is damaged: it is trained again" in caplog.text
        (folder / name).write_bytes(whole)
    (folder / "last.ckpt").write_bytes(flipped(whole))
    caplog.clear()
    other = toy("selftraining=none", "experiment_name=other")
    assert train(other).final == read_metrics(hashing.run_folder(toy("selftraining=none"))).final
    assert not taken(caplog)
    assert take("repaired")


def test_what_cannot_be_written_is_a_warning(toy, tmp_path, caplog):
    (tmp_path / "file").write_text("")
    metrics = train(toy("selftraining=none", f"paths.warmup_dir={tmp_path / 'file'}"))
    assert metrics.status == "finished"
    assert "the warm-up cannot be shared" in caplog.text
