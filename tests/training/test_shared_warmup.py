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
from omegaconf import OmegaConf

from qs3.config.hydra import run_folder
from qs3.runs.checkpoints import load
from qs3.training import shared_warmup
from qs3.training.command import train
from qs3.training.shared_warmup import SharedWarmup, warmup_sha256
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


SHA256 = "0123456789abcdef" * 4


def started(folder: Path) -> Path:
    """The folder of a run that is one epoch away from its warm-up's end; no two are alike."""
    folder.mkdir()
    for name in ("history.csv", "last.ckpt"):
        (folder / name).write_text(f"{name} of {folder.name}")
    return folder


def give(warmups: Path, folder: Path, epoch: int = 0, warmup: int = 2) -> None:
    """What the run does at the end of an epoch."""
    over = SimpleNamespace(current_epoch=epoch, is_global_zero=True)
    SharedWarmup(folder, warmups, SHA256, 7, warmup).on_train_epoch_end(over, None)


def one_that_takes(folder: Path, warmups: Path | None, sha256: str = SHA256, seed: int = 7):
    folder.mkdir(exist_ok=True)
    return SharedWarmup(folder, warmups, sha256, seed, 3)


@pytest.mark.parametrize("warmup", [1, 2, 3, 6])
def test_it_is_shared_one_epoch_before_its_end_and_once(tmp_path, warmup, caplog):
    warmups, first = tmp_path / "warmups", started(tmp_path / "first")
    where = warmups / "01234567-seed7"
    for epoch in range(warmup + 2):
        give(warmups, first, epoch, warmup)
        assert where.exists() == (0 <= warmup - 2 <= epoch)
    other = one_that_takes(tmp_path / "other", warmups)
    if warmup == 1:
        assert not other.take()
        return
    files = {name: sha256_file(where / name) for name in ("history.csv", "last.ckpt")}
    mark = {"warmup_sha256": SHA256, "files": files}
    assert json.loads((where / "started.json").read_text()) == mark
    assert other.take()
    assert f"going on from {where}" in caplog.text
    for name in files:
        assert (other.folder / name).read_bytes() == (where / name).read_bytes()
    assert not other.take()  # it has begun
    give(warmups, started(tmp_path / "second"), warmup - 2, warmup)
    assert (where / "last.ckpt").read_text() == "last.ckpt of first"


def test_what_a_copy_that_was_killed_left_is_cleared(tmp_path):
    where = tmp_path / "warmups" / "01234567-seed7"
    where.mkdir(parents=True)
    (where / ".last.ckpt.abc.tmp.ckpt").write_text("half")
    give(tmp_path / "warmups", started(tmp_path / "first"))
    assert sorted(path.name for path in where.glob("*.ckpt")) == ["last.ckpt"]


@pytest.mark.parametrize("different", ["sha256", "seed", "nothing is shared"])
def test_nobody_elses_is_taken(tmp_path, different, caplog):
    warmups, mine = tmp_path / "warmups", tmp_path / "mine"
    give(warmups, started(tmp_path / "first"))
    one = {
        "sha256": one_that_takes(mine, warmups, SHA256[:-1] + "0"),  # of the same name
        "seed": one_that_takes(mine, warmups, seed=8),
        "nothing is shared": one_that_takes(mine, None),
    }[different]
    assert not one.take()
    assert not any(mine.iterdir())
    assert ("is damaged" in caplog.text) == (different == "sha256")


def test_runs_that_start_together_share_one(tmp_path, caplog, monkeypatch):
    """Others come while the first one's files are there and their mark is not."""
    warmups, second = tmp_path / "warmups", started(tmp_path / "second")
    third = one_that_takes(tmp_path / "third", warmups)
    found, threads = [], []

    def come_meanwhile(source: Path, target: Path) -> None:
        copy_file(source, target)
        if source.name == "last.ckpt" and not threads:
            jobs = (lambda: give(warmups, second)), (lambda: found.append(third.take()))
            threads.extend(threading.Thread(target=job) for job in jobs)
            for thread in threads:
                thread.start()
                thread.join(0.2)

    monkeypatch.setattr(shared_warmup, "copy_file", come_meanwhile)
    give(warmups, started(tmp_path / "first"))
    for thread in threads:
        thread.join()
    assert found == [True]  # it waited for the mark
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    assert (tmp_path / "third" / "last.ckpt").read_text() == "last.ckpt of first"
    assert one_that_takes(tmp_path / "fourth", warmups).take()


def test_one_killed_while_it_replaces_a_damaged_one_leaves_none(tmp_path, caplog, monkeypatch):
    warmups = tmp_path / "warmups"
    give(warmups, started(tmp_path / "first"))
    (where,) = warmups.iterdir()
    (where / "last.ckpt").write_text("damaged")

    def killed(source: Path, target: Path) -> None:
        raise SystemExit

    with monkeypatch.context() as during:
        during.setattr(shared_warmup, "copy_file", killed)
        with pytest.raises(SystemExit):
            give(warmups, started(tmp_path / "second"))
    third = one_that_takes(tmp_path / "third", warmups)
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
    assert one_that_takes(tmp_path / "second", warmups).take()
    assert not (where / ".lock").exists()


def test_the_hash_covers_what_comes_before():
    plain = {
        "paths": {"scratch": "a"},
        "model": {"k": 20, "notes": "${paths.scratch}"},
        "selection": {"teacher": "last"},
        "selftraining": {"rounds": 3},
        "evaluation": {"turns": 4},
        "experiment_name": "a",
    }
    begun = {"data": {"source": "a"}, "versions": {"a": 1, "b": 2}, "threads": 1, "files": {}}

    def of(key="", value=None, **more):
        cfg = OmegaConf.create(plain)
        if key:
            OmegaConf.update(cfg, key, value)
        return warmup_sha256(cfg, begun | more)

    for key, value in (
        *(("paths.scratch", "b"), ("selftraining.rounds", 4)),
        *(("evaluation", None), ("experiment_name", "b")),
    ):
        assert of(key, value) == of(), key
    assert of(versions={"b": 2, "a": 1}) == of()
    others = [of("model.k", 10), of("selection.teacher", "best"), of(threads=2)]
    others += [of(versions={"a": 1, "b": 3}), of(data={"source": "b"}), of(files={"a": "b"})]
    assert len({of(), *others}) == 7


@pytest.mark.parametrize("key", ["selftraining.rounds", "evaluation.turns", "experiment_name"])
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
    more = [f"selftraining={selftraining}"]
    alone = toy(*more, "paths.warmup_dir=null")
    train(alone)
    expected = result_of(run_folder(alone))
    weights = load(run_folder(alone) / "student.pt")
    shutil.rmtree(run_folder(alone))
    assert not shared_folders(tmp_path)

    train(toy("selftraining=none", "experiment_name=other"))
    assert len(shared_folders(tmp_path)) == 1
    assert not taken(caplog)
    train(toy(*more))
    assert taken(caplog)
    assert result_of(run_folder(alone)) == expected
    again = load(run_folder(alone) / "student.pt")
    assert all(torch.equal(weights[name], again[name]) for name in weights)


def test_a_damaged_one_is_no_warm_up(tmp_path, caplog):
    warmups = tmp_path / "warmups"
    give(warmups, started(tmp_path / "first"))
    (where,) = warmups.iterdir()
    for i, name in enumerate(("history.csv", "last.ckpt", "last.ckpt", "started.json")):
        whole = (where / name).read_bytes()
        (where / name).write_bytes(flipped(whole) if i < 2 else b"{")
        if i == 2:
            (where / name).unlink()
        caplog.clear()
        assert not one_that_takes(tmp_path / str(i), warmups).take()
        assert f"the warm-up in {where} is damaged: it is trained again" in caplog.text
        (where / name).write_bytes(whole)
    assert one_that_takes(tmp_path / "whole", warmups).take()


def test_what_cannot_be_written_is_a_warning(toy, tmp_path, caplog):
    (tmp_path / "file").write_text("")
    words = ("selftraining=none", "protocol.epochs=2", f"paths.warmup_dir={tmp_path / 'file'}")
    metrics = train(toy(*words))
    assert metrics.status == "finished"
    assert "the warm-up cannot be shared" in caplog.text
