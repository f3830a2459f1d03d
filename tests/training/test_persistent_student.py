"""The released code's student: new once, then the same weights and moments in all rounds."""

from __future__ import annotations

import contextlib

import torch

from qs3.config import hashing
from qs3.config.hydra import build
from qs3.engine.classifier import Classifier
from qs3.runs.checkpoints import LAST, copy_weights
from qs3.training.command import train
from qs3.utils.seeding import derive
from tests.training.conftest import result_of


def test_it_is_new_in_round_0_and_kept_afterwards(toy, monkeypatch):
    first: dict[int, dict[str, torch.Tensor]] = {}
    last: dict[int, dict[str, torch.Tensor]] = {}
    steps: dict[int, float] = {}  # of Adam before an epoch's first step

    def spy(self, batch, batch_idx, real=Classifier.training_step):
        epoch = self.current_epoch
        if epoch not in first:
            first[epoch] = copy_weights(self.net)
            state = self.optimizers().state
            steps[epoch] = max((float(s["step"]) for s in state.values()), default=0.0)
        return real(self, batch, batch_idx)

    def end(self, real=Classifier.on_validation_epoch_end):
        last[self.current_epoch] = copy_weights(self.net)
        real(self)

    monkeypatch.setattr(Classifier, "training_step", spy)
    monkeypatch.setattr(Classifier, "on_validation_epoch_end", end)
    cfg = toy("selftraining.init=persistent", "selftraining.theta=0.35")
    train(cfg)
    fresh = [torch.load(_init_of(cfg, phase)) for phase in (0, 1)]
    for name, weights in last[6].items():
        assert torch.equal(first[4][name], fresh[1][name]), name  # no warm-up's weights
        assert torch.equal(first[7][name], weights), name  # nor a second new student's
    assert not torch.equal(fresh[0]["lift.weight"], fresh[1]["lift.weight"])
    assert steps[4] == 0
    assert steps[7] > steps[5] > 0


def _init_of(cfg, phase):
    """A file with the weights that a phase begins with if it begins anew."""
    path = hashing.run_folder(cfg) / f"init_{phase}.pt"
    torch.manual_seed(derive(cfg.seed, "init", phase))
    torch.save(build(cfg.model).state_dict(), path)
    return path


def test_an_interrupted_run_ends_the_same(toy, tmp_path, monkeypatch):
    settings = ("selftraining.init=persistent", "selftraining.theta=0.35")
    whole, cut = (toy(*settings, f"paths.log_dir={tmp_path / name}") for name in ("whole", "cut"))
    train(whole)

    def stop(self, batch, batch_idx, real=Classifier.training_step):
        if self.current_epoch == 7:
            raise KeyError("cut")
        return real(self, batch, batch_idx)

    with monkeypatch.context() as patch:
        patch.setattr(Classifier, "training_step", stop)
        with contextlib.suppress(KeyError):
            train(cut)
    assert (hashing.run_folder(cut) / LAST).is_file()
    train(cut)
    assert result_of(hashing.run_folder(cut)) == result_of(hashing.run_folder(whole))
