"""What a run brings along from another place (`ckpt_path`)."""

from __future__ import annotations

from pathlib import Path

import pytest

from qs3.errors import Qs3Error
from qs3.training.resume import bring


def test_what_going_on_takes_and_nothing_else(tmp_path: Path) -> None:
    comes = ["last.ckpt", "history.csv", "warmup_selected.pt", "round_00/pseudo_labels.csv"]
    stays = [".hydra/config.yaml", ".lock", "wandb/run/x", "pictures/index.html", "started.json"]
    stays += ["metrics.json", "train.log", "round_00/x.log"]
    for name in comes + stays:
        path = tmp_path / "there" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "started.json").write_text("its own")
    bring(tmp_path / "there", tmp_path / "here")
    found = {str(f.relative_to(tmp_path / "here")): f for f in (tmp_path / "here").rglob("*")}
    files = {name: path.read_text() for name, path in found.items() if path.is_file()}
    assert files == {"started.json": "its own", **{name: name for name in comes}}


def test_the_checkpoint_comes_last(tmp_path: Path) -> None:
    """What cannot be brought leaves a folder without a checkpoint: a run that has not begun."""
    (tmp_path / "there").mkdir()
    for name in ("last.ckpt", "z.pt"):
        (tmp_path / "there" / name).write_text(name)
    (tmp_path / "here" / "z.pt").mkdir(parents=True)  # in the way
    with pytest.raises((OSError, Qs3Error)):
        bring(tmp_path / "there", tmp_path / "here")
    assert [path.name for path in (tmp_path / "here").iterdir()] == ["z.pt"]
