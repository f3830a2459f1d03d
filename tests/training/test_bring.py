"""What a run brings along from another place (`ckpt_path`), without training any."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from qs3.errors import DataError, MissingDataError, Qs3Error
from qs3.runs.checkpoints import save
from qs3.runs.folder import write_started
from qs3.training.resume import bring, take_checkpoint
from qs3.training.run import Run, run_of
from qs3.utils.locks import owned
from tests.training.toy import toy_config

STARTED = {
    "config_sha256": "c0ffee",
    "data": {"source": "5", "target": "7"},
    "versions": {"torch": torch.__version__},
}


def run_with(folder: Path, *overrides: str) -> Run:
    """A run that has not begun."""
    return run_of(toy_config(folder, *overrides))


def begin(folder: Path) -> Path:
    """The folder of a run that was begun; returns its checkpoint."""
    folder.mkdir(parents=True)
    write_started(folder, STARTED)
    save({"epoch": torch.tensor(3)}, folder / "last.ckpt")
    return folder / "last.ckpt"


@pytest.mark.parametrize("named", ["folder", "file", "file by another spelling"])
def test_the_same_run_is_brought_from_elsewhere(tmp_path: Path, named: str) -> None:
    name = run_with(tmp_path).folder.name
    there = begin(tmp_path / "elsewhere" / name)
    spelling = {
        "folder": there.parent,
        "file": there,
        "file by another spelling": f"{tmp_path}/./elsewhere/../elsewhere/{name}/last.ckpt",
    }
    run = run_with(tmp_path, f"ckpt_path={spelling[named]}")
    take_checkpoint(run, STARTED)
    assert (run.folder / "last.ckpt").read_bytes() == there.read_bytes()


@pytest.mark.parametrize("rank", ["1", "2"])
def test_processes_beside_the_first_leave_it_to_that(
    tmp_path: Path, rank: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = begin(tmp_path / "elsewhere" / run_with(tmp_path).folder.name)
    run = run_with(tmp_path, f"ckpt_path={there}")
    monkeypatch.setitem(os.environ, "LOCAL_RANK", rank)
    take_checkpoint(run, STARTED)
    assert not run.folder.exists()
    monkeypatch.setitem(os.environ, "LOCAL_RANK", "0")
    take_checkpoint(run, STARTED)
    assert (run.folder / "last.ckpt").is_file()


def test_a_run_with_a_checkpoint_of_its_own_takes_no_other(tmp_path: Path) -> None:
    run = run_with(tmp_path, f"ckpt_path={tmp_path}/nowhere")
    own = begin(run.folder).read_bytes()
    take_checkpoint(run, STARTED)
    assert (run.folder / "last.ckpt").read_bytes() == own


@pytest.mark.parametrize("file", ["a.ckpt", "zero.ckpt"])
def test_another_file_of_the_run_is_no_checkpoint(tmp_path: Path, file: str) -> None:
    """Whether its name sorts before that of the checkpoint or behind it."""
    there = begin(tmp_path / "elsewhere" / run_with(tmp_path).folder.name)
    other = there.rename(there.with_name(file))
    run = run_with(tmp_path, f"ckpt_path={other}")
    with pytest.raises(MissingDataError, match=r"last\.ckpt"):
        take_checkpoint(run, STARTED)


def test_a_folder_whose_name_sorts_behind_the_word_last(tmp_path: Path) -> None:
    run = run_with(tmp_path, "ckpt_path=yesterday")
    with pytest.raises(MissingDataError, match=r"last\.ckpt"):
        take_checkpoint(run, STARTED)


@pytest.mark.parametrize("name", ["seed0-00000000", "seed9-ffffffff"])
def test_another_run_is_refused(tmp_path: Path, name: str) -> None:
    there = begin(tmp_path / "elsewhere" / name)
    run = run_with(tmp_path, f"ckpt_path={there}")
    with pytest.raises(MissingDataError, match="not the folder of this run"):
        take_checkpoint(run, STARTED)
    assert not run.folder.exists()


def test_a_run_on_other_data_or_in_training_is_refused(tmp_path: Path) -> None:
    there = begin(tmp_path / "elsewhere" / run_with(tmp_path).folder.name)
    run = run_with(tmp_path, f"ckpt_path={there}")
    with pytest.raises(DataError, match=r"data\.target"):
        take_checkpoint(run, STARTED | {"data": {"source": "5", "target": "8"}})
    with owned(there.parent), pytest.raises(Qs3Error, match="another process"):
        take_checkpoint(run, STARTED)
    assert not run.folder.exists()
    there.with_name("started.json").unlink()
    with pytest.raises(MissingDataError):
        take_checkpoint(run, STARTED)


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
