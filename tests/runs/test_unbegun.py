from __future__ import annotations

from pathlib import Path

import pytest

from qs3.errors import ConfigError
from qs3.runs.folder import write_started
from qs3.runs.unbegun import is_unbegun, removed_if_unbegun


def start(folder: Path) -> None:
    """What `train.py` writes before the first epoch."""
    (folder / ".hydra").mkdir(parents=True)
    for name in (".hydra/config.yaml", ".lock", "train.log"):
        (folder / name).touch()
    write_started(folder, {"data": {}})


def fail(folder: Path) -> None:
    with pytest.raises(ConfigError, match="no"), removed_if_unbegun(folder):
        raise ConfigError("no")


def test_a_start_that_failed_before_its_first_epoch_leaves_nothing(tmp_path):
    start(folder := tmp_path / "logs" / "experiment" / "seed0-01234567")
    assert is_unbegun(folder)
    fail(folder)
    assert list((tmp_path / "logs").iterdir()) == []


@pytest.mark.parametrize("file", ["last.ckpt", "history.csv", "wandb/run", "notes.txt"])
def test_what_else_lies_there_stays_and_all_with_it(file, tmp_path):
    start(folder := tmp_path / "seed0-01234567")
    (folder / file).parent.mkdir(exist_ok=True)
    (folder / file).touch()
    before = sorted(folder.rglob("*"))
    fail(folder)
    assert not is_unbegun(folder)
    assert sorted(folder.rglob("*")) == before
