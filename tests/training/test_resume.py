"""An interrupted run, started again, ends as an uninterrupted one."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from lightning.pytorch import Callback
from omegaconf import open_dict

import qs3.checkpoints
import qs3.runs
import qs3.selftraining.callback
from qs3 import runs
from qs3.checkpoints import load
from qs3.run import train
from tests.training.conftest import result_of
from tests.training.toy import overrides


class Stop(Exception):
    """Stands for a kill."""


class StopAt(Callback):
    """Raises in one hook, the n-th time."""

    def __init__(self, hook: str, count: int) -> None:
        self.left = count

        def stop(*args: object, **kwargs: object) -> None:
            self.left -= 1
            if self.left == 0:
                raise Stop

        setattr(self, hook, stop)

    # Lightning looks hooks up by name; these are replaced on the instance.
    def on_train_batch_end(self, *args, **kwargs): ...
    def on_train_epoch_start(self, *args, **kwargs): ...
    def on_train_epoch_end(self, *args, **kwargs): ...
    def on_validation_batch_end(self, *args, **kwargs): ...
    def on_train_start(self, *args, **kwargs): ...
    def on_train_end(self, *args, **kwargs): ...


def interrupt(cfg, hook: str, count: int) -> None:
    stopping = cfg.copy()
    with open_dict(stopping):
        stopping.callbacks.progress = {
            "_target_": "tests.training.test_resume.StopAt",
            "hook": hook,
            "count": count,
        }
    assert runs.config_hash(stopping) == runs.config_hash(cfg)
    with pytest.raises(Stop):
        train(stopping)


# 10 epochs: 0-3 warm-up, 4-6 round 0, 7-9 round 1; 4 batches an epoch of the warm-up
@pytest.mark.parametrize(
    ("hook", "count"),
    [
        ("on_train_start", 1),
        ("on_train_batch_end", 2),  # before the first checkpoint
        ("on_train_batch_end", 7),  # mid epoch 1
        ("on_train_batch_end", 17),  # first epoch of round 0, weights just reset
        ("on_validation_batch_end", 3),
        ("on_train_epoch_start", 5),  # between selection and the first batch of round 0
        ("on_train_epoch_end", 4),  # selected, but not yet in a checkpoint
        ("on_train_epoch_end", 7),
        ("on_train_epoch_end", 10),  # last epoch
        ("on_train_end", 1),
    ],
)
def test_interrupted_in_a_hook(toy, finished, hook, count):
    cfg = toy()
    interrupt(cfg, hook, count)
    train(cfg)
    assert result_of(runs.run_folder(cfg)) == result_of(finished)
    ours = load(runs.run_folder(cfg) / "last.ckpt")
    theirs = load(finished / "last.ckpt")
    assert ours["state_dict"].keys() == theirs["state_dict"].keys()
    for name, value in theirs["state_dict"].items():
        assert torch.equal(ours["state_dict"][name], value), name


def test_interrupted_again_and_again(toy, finished):
    cfg = toy()
    for hook, count in [
        ("on_train_batch_end", 6),
        ("on_train_epoch_end", 2),
        ("on_train_batch_end", 5),
        ("on_train_epoch_start", 3),
        ("on_train_epoch_end", 3),
    ]:
        interrupt(cfg, hook, count)
    train(cfg)
    assert result_of(runs.run_folder(cfg)) == result_of(finished)


@pytest.mark.parametrize("call", [1, 4, 5, 6, 10])
def test_interrupted_while_a_checkpoint_is_written(toy, finished, monkeypatch, call):
    cfg = toy()
    calls = 0

    def half_a_file(value, file):
        nonlocal calls
        calls += 1
        if calls == call:
            Path(file).write_bytes(b"half")
            raise Stop
        return real(value, file)

    real = torch.save
    with monkeypatch.context() as patch:
        patch.setattr(qs3.checkpoints.torch, "save", half_a_file)
        with pytest.raises(Stop):
            train(cfg)
    train(cfg)
    assert result_of(runs.run_folder(cfg)) == result_of(finished)


@pytest.mark.parametrize(
    ("module", "name", "call"),
    [
        (qs3.selftraining.callback, "predict", 1),
        (qs3.selftraining.callback, "predict", 2),
        (qs3.selftraining.callback, "write_pseudo_labels", 1),
        (qs3.selftraining.callback, "check_selection", 2),
        (qs3.runs, "write_metrics", 1),
    ],
)
def test_interrupted_in_a_function(toy, finished, monkeypatch, module, name, call):
    cfg = toy()
    calls = 0
    real = getattr(module, name)

    def stop(*args, **kwargs):
        nonlocal calls
        calls += 1
        if calls == call:
            raise Stop
        return real(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(module, name, stop)
        with pytest.raises(Stop):
            train(cfg)
    train(cfg)
    assert result_of(runs.run_folder(cfg)) == result_of(finished)


@pytest.mark.slow
def test_killed_at_random_instants(toy_data, tmp_path, finished):
    """SIGKILL, 24 times in all over several runs, at instants spread over start, fit and end."""
    root = Path(__file__).parents[2]
    command = [sys.executable, str(root / "train.py")]
    command += overrides(tmp_path, f"paths.data_dir={toy_data}")
    environment = {**os.environ, "PYTHONPATH": str(root)}
    rng, kills, number = random.Random(0), 0, 0
    began = time.monotonic()
    subprocess.run([*command, "seed=9"], cwd=tmp_path, env=environment, check=True)
    whole = time.monotonic() - began

    while kills < 24:
        number += 1
        log_dir = tmp_path / f"logs{number}"
        arguments = [*command, f"paths.log_dir={log_dir}"]
        while True:
            process = subprocess.Popen(arguments, cwd=tmp_path, env=environment)
            try:
                # imports take most of the time: aim at the rest
                process.wait(timeout=rng.uniform(0.5, 1.05) * whole)
                assert process.returncode == 0
                break
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.wait()
                kills += 1
        (folder,) = (log_dir / "quickstart").iterdir()
        assert result_of(folder) == result_of_as(finished, folder)


def result_of_as(finished: Path, folder: Path) -> dict:
    """The result of `finished`; names of the config groups differ without Hydra's command line."""
    expected = result_of(finished)
    for key in ("method", "selftraining", "model"):
        expected["metrics"][key] = result_of(folder)["metrics"][key]
    return expected
