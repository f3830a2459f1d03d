"""Few clouds of each split; runs that something else began or damaged."""

from __future__ import annotations

import json

import pytest

from qs3.config import hashing
from qs3.errors import DataError
from qs3.training.command import train
from tests.training.conftest import result_of
from tests.training.watching import interrupt


def test_a_run_of_few_clouds_leaves_no_cache(toy, tmp_path):
    cfg = toy("data.clouds_a_split=12", "selftraining=none", f"data.cache_dir={tmp_path / 'cache'}")
    metrics = train(cfg)
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
    interrupt(cfg, epoch=6)
    change_started(hashing.run_folder(cfg), torch="1.0", threads=77)
    metrics = train(cfg)
    assert "begun with torch 1.0, threads 77, continued with torch" in caplog.text
    assert metrics.versions["torch"] == "1.0"
    ours, theirs = result_of(hashing.run_folder(cfg)), result_of(finished)
    for result in (ours, theirs):
        del result["metrics"]["versions"]
    assert ours == theirs


def test_a_checkpoint_with_a_flipped_bit_is_refused(toy):
    cfg = toy("paths.warmup_dir=null")
    interrupt(cfg, epoch=1)
    own = hashing.run_folder(cfg) / "last.ckpt"
    data = bytearray(own.read_bytes())
    data[len(data) // 2] ^= 1
    own.write_bytes(data)
    with pytest.raises(DataError, match=r"last\.ckpt"):
        train(cfg)


@pytest.mark.parametrize("changed", [{}, {"torch": "1.0"}, {"files": {"qs3's code": "0" * 64}}])
def test_a_warm_up_of_two_versions_is_given_to_nobody(toy, changed, tmp_path, caplog):
    cfg = toy(f"paths.warmup_dir={tmp_path / 'warmups'}")
    interrupt(cfg, epoch=2)
    change_started(hashing.run_folder(cfg), **changed)
    train(cfg)
    assert ("begun with" in caplog.text) == bool(changed)
    assert (tmp_path / "warmups").exists() == (not changed)
