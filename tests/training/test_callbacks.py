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


def test_a_run_that_a_callback_has_ended_is_not_finished(toy):
    """It was reported as if all its rounds had been."""
    cfg = toy("+callbacks.stop._target_=tests.training.test_callbacks.Stop")
    with pytest.raises(ConfigError, match="ended after 2 of 10"):
        train(cfg)
    assert not (hashing.run_folder(cfg) / "metrics.json").exists()
