"""Callbacks of Lightning beside those that training needs."""

from __future__ import annotations

import pytest
from lightning.pytorch import Callback

from qs3.config import hashing
from qs3.errors import ConfigError
from qs3.training.command import train

_LIGHTNINGS = "lightning.pytorch.callbacks"
CHOICE = f"{{_target_:{_LIGHTNINGS}.ModelCheckpoint,monitor:source_val/acc,mode:max}}"


class Stop(Callback):
    """Ends a training in its warm-up, as somebody's own early stopping would."""

    def on_train_epoch_end(self, trainer, pl_module) -> None:
        trainer.should_stop = trainer.current_epoch >= 1


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ("EarlyStopping,monitor:source_val/acc,mode:max", "EarlyStopping ends a training early"),
        ("Timer,duration:{hours:1}", "Timer ends a training early"),
        ("StochasticWeightAveraging,swa_lrs:0.01", "StochasticWeightAveraging averages weights"),
        ("EMAWeightAveraging", "EMAWeightAveraging averages weights"),
    ],
)
def test_what_ends_phases_or_changes_selected_weights_is_refused(settings, why, toy):
    word = f"+callbacks.more={{_target_:{_LIGHTNINGS}.{settings}}}"
    with pytest.raises(ConfigError, match=rf"^callbacks: {why}"):
        train(toy(word, "selftraining=none"))


def test_a_run_that_a_callback_has_ended_is_not_finished(toy):
    """It was reported as if all its rounds had been."""
    cfg = toy("+callbacks.stop._target_=tests.training.test_callbacks.Stop")
    with pytest.raises(ConfigError, match=r"^training ended after 2 of 10 epochs, as a callback"):
        train(cfg)
    assert not (hashing.run_folder(cfg) / "metrics.json").exists()


def test_others_are_taken(toy):
    cfg = toy(f"+callbacks.best={CHOICE}", "selftraining=none", "protocol.epochs=2")
    train(cfg)
    assert list(hashing.run_folder(cfg).rglob("epoch=*.ckpt"))
