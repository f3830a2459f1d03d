"""debug=overfit, few clouds of each split, and `ckpt_path` in whole runs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from qs3.config import hashing
from qs3.errors import DataError, MissingDataError
from qs3.training.command import train
from tests.training.conftest import result_of
from tests.training.watching import interrupt


def test_a_run_of_few_clouds_leaves_no_cache(toy, tmp_path):
    cfg = toy("data.clouds_a_split=12", "selftraining=none", f"data.cache_dir={tmp_path / 'cache'}")
    metrics = train(cfg)
    assert metrics.final.n == 12
    assert not list((tmp_path / "cache").rglob("*.npy"))


def test_ckpt_path_last_insists_on_a_checkpoint(toy, finished):
    cfg = toy("ckpt_path=last")
    absent = toy("ckpt_path=last", "data.make_source=true", "paths.data_dir=/nowhere")
    for one in (cfg, absent):  # before the source is made
        with pytest.raises(MissingDataError, match=r"last\.ckpt"):
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
    return moved


def change_started(folder, **changes) -> None:
    """`started.json` of a run that other software began."""
    file = folder / "started.json"
    document = json.loads(file.read_text())
    for key, value in changes.items():
        (document["versions"] if key == "torch" else document)[key] = value
    file.write_text(json.dumps(document))


def test_ckpt_path_brings_a_run_from_elsewhere(toy, begun, finished, caplog):
    """And warns of other versions, also when it goes on from its own checkpoint afterwards."""
    cfg = toy(f"ckpt_path={begun}", "paths.warmup_dir=null")
    interrupt(cfg, epoch=7)
    assert "begun with" not in caplog.text
    change_started(hashing.run_folder(cfg), torch="1.0", threads=77)
    metrics = train(cfg)
    assert "begun with torch 1.0, threads 77, continued with torch" in caplog.text
    assert metrics.versions["torch"] == "1.0"
    ours, theirs = result_of(hashing.run_folder(cfg)), result_of(finished)
    for result in (ours, theirs):
        del result["metrics"]["versions"]
    assert ours == theirs


def test_a_checkpoint_with_a_flipped_bit_is_refused(toy, begun):
    data = bytearray((begun / "last.ckpt").read_bytes())
    data[len(data) // 2] ^= 1
    (begun / "last.ckpt").write_bytes(data)
    alone = "paths.warmup_dir=null"
    with pytest.raises(DataError, match=r"last\.ckpt"):
        train(toy(f"ckpt_path={begun}", alone))
    own = hashing.run_folder(toy(alone)) / "last.ckpt"
    assert not own.exists()
    shutil.copy(begun / "last.ckpt", own)
    with pytest.raises(DataError, match=r"last\.ckpt"):
        train(toy(alone))


@pytest.mark.parametrize("changed", [{}, {"torch": "1.0"}, {"files": {"qs3's code": "0" * 64}}])
def test_a_warm_up_of_two_versions_is_given_to_nobody(toy, changed, tmp_path, caplog):
    cfg = toy(f"paths.warmup_dir={tmp_path / 'warmups'}")
    interrupt(cfg, epoch=2)
    change_started(hashing.run_folder(cfg), **changed)
    train(cfg)
    assert ("begun with" in caplog.text) == bool(changed)
    assert (tmp_path / "warmups").exists() == (not changed)
