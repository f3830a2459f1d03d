"""A warm-up trained by another run gives the same result, to the bit, as one's own."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

import pytest
import torch

from qs3.config import hashing
from qs3.runs.checkpoints import load
from qs3.runs.metrics import read_metrics
from qs3.training.command import train
from qs3.training.shared_warmup import SharedWarmup
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


def test_another_warmup_is_not_taken(toy, tmp_path, caplog):
    short = ("selftraining=none", "protocol.epochs=3")
    train(toy(*short))
    changes = ("protocol.epochs=2", "seed=1", "method=source_only", "selection.teacher=last")
    for number, change in enumerate(changes, 2):
        train(toy(*short, change))
        assert not taken(caplog), change
        assert len(shared_folders(tmp_path)) == number


def test_a_damaged_mark_is_as_good_as_none(toy, tmp_path, caplog):
    train(toy("selftraining=none"))
    (folder,) = shared_folders(tmp_path)
    (folder / "started.json").write_text("{")
    train(toy("selftraining=none", "experiment_name=other"))
    assert not taken(caplog)
    train(toy("selftraining=none", "experiment_name=third"))  # it was repaired
    assert taken(caplog)


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


def test_force_trains_anew(toy, caplog):
    train(toy("selftraining=none"))
    train(toy("selftraining=none", "experiment_name=other", "force=true"))
    assert not taken(caplog)


def test_what_cannot_be_written_is_a_warning(toy, tmp_path, caplog):
    (tmp_path / "file").write_text("")
    metrics = train(toy("selftraining=none", f"paths.warmup_dir={tmp_path / 'file'}"))
    assert metrics.status == "finished"
    assert "the warm-up cannot be shared" in caplog.text
