"""An interrupted run, started again, ends as an uninterrupted one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import qs3.runs.checkpoints
import qs3.selftraining.callback
import qs3.training.command
import qs3.training.fit
from qs3.config.hydra import run_folder
from qs3.engine.classifier import Classifier
from qs3.runs.checkpoints import load
from qs3.training.command import train
from tests.training.conftest import result_of
from tests.training.toy import overrides
from tests.training.watching import Stop, interrupt

ROOT = Path(__file__).parents[2]


def slow(*values: str):
    return pytest.param(*values, marks=pytest.mark.slow)


# 7 epochs: 0-2 warm-up, 3-4 round 0, 5-6 round 1; 4 batches an epoch of the warm-up
@pytest.mark.parametrize(
    ("hook", "count"),
    [
        slow("on_train_start", 1),
        ("on_train_batch_end", 2),  # before the first checkpoint
        slow("on_train_batch_end", 7),  # mid epoch 1
        slow("on_train_batch_end", 13),  # first epoch of round 0, weights just reset
        slow("on_validation_batch_end", 3),
        ("on_train_epoch_start", 4),  # between selection and the first batch of round 0
        slow("on_train_epoch_end", 3),  # selected, but not yet in a checkpoint
        ("on_train_epoch_end", 5),
        slow("on_train_epoch_end", 7),  # last epoch
        slow("on_train_end", 1),
    ],
)
def test_interrupted_in_a_hook(toy, finished, hook, count):
    cfg = toy()
    interrupt(cfg, hook, count)
    train(cfg)
    assert result_of(run_folder(cfg)) == result_of(finished)
    ours = load(run_folder(cfg) / "last.ckpt")
    theirs = load(finished / "last.ckpt")
    assert ours["state_dict"].keys() == theirs["state_dict"].keys()
    for name, value in theirs["state_dict"].items():
        assert torch.equal(ours["state_dict"][name], value), name


def test_it_goes_on_with_the_threads_that_it_was_begun_with(toy, monkeypatch):
    """Free cores are counted once: sums are ordered by threads."""
    before = torch.get_num_threads()
    try:
        cfg = toy("trainer.threads=auto", "selftraining=none", "protocol.epochs=2")
        monkeypatch.setattr(qs3.training.fit, "free_cores", lambda: 2)
        interrupt(cfg, "on_train_epoch_start", 2)
        assert torch.get_num_threads() == 2
        monkeypatch.setattr(qs3.training.fit, "free_cores", lambda: 1)
        train(cfg)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("call", [1, slow(3), slow(4), slow(5), slow(8)])
def test_interrupted_while_a_checkpoint_is_written(toy, finished, monkeypatch, call):
    cfg = toy()
    calls = 0

    def half_a_file(value, file):
        nonlocal calls
        calls += 1
        if calls == call:
            file.write(b"half")
            raise Stop
        return real(value, file)

    real = torch.save
    with monkeypatch.context() as patch:
        patch.setattr(qs3.runs.checkpoints.torch, "save", half_a_file)
        with pytest.raises(Stop):
            train(cfg)
    train(cfg)
    assert result_of(run_folder(cfg)) == result_of(finished)


@pytest.mark.parametrize(
    ("module", "name", "call"),
    [
        (qs3.selftraining.callback, "predict", 1),
        slow(qs3.selftraining.callback, "predict", 2),
        (qs3.selftraining.callback, "write_pseudo_labels", 1),
        slow(qs3.selftraining.callback, "check_selection", 2),
        (qs3.training.command, "write_metrics", 1),
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
    assert result_of(run_folder(cfg)) == result_of(finished)


def test_sigterm_is_status_143_also_in_a_worker_of_a_sweep(toy, monkeypatch):
    """Lightning ends with status 0; who called it would think that the run is finished."""
    cfg = toy()

    def terminate(self, real=Classifier.on_train_epoch_start):
        real(self)
        os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Classifier, "on_train_epoch_start", terminate)
        with pytest.raises(SystemExit) as ended:
            train(cfg)
    assert ended.value.code == 143
    assert not (run_folder(cfg) / "metrics.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT], ids=lambda how: how.name)
@pytest.mark.parametrize(
    "more", [["seed=0"], ["seed=0,1", "-m"], ["seed=0,1", "hydra/launcher=joblib", "-m"]], ids=str
)
def test_a_training_that_is_ended_says_so(how, more, toy_data, tmp_path):
    words = overrides(tmp_path, f"paths.data_dir={toy_data}", "protocol.epochs=2000")
    words = [word for word in words if not word.startswith("seed=")]
    process = subprocess.Popen(
        [sys.executable, str(ROOT / "train.py"), *words, *more],
        env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True, cwd=tmp_path,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    while not list(tmp_path.glob("logs/*/seed*/last.ckpt")) and process.poll() is None:
        time.sleep(0.1)
    process.send_signal(how)
    out, said = process.communicate(timeout=120)
    assert process.returncode == 128 + how, said
    assert "Traceback" not in out + said
    assert said.endswith("ed; run the same command again and it continues\n")
