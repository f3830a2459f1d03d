"""Steps of several batches (`trainer.accumulate_grad_batches`): a mean moves once in each."""

from __future__ import annotations

import pytest

from qs3.config import hashing
from qs3.errors import ConfigError
from qs3.runs.checkpoints import load
from qs3.training.command import train

FEATURED = "model._target_=tests.training.nets.featured"
# Each epoch 15 batches of 4 clouds of 60: its last step is of one batch.
SETTINGS = (
    *(FEATURED, "protocol.epochs=2", "protocol.batch_size=4", "selftraining=none"),
    *("+trainer.accumulate_grad_batches=2", "paths.warmup_dir=null"),
)


def test_means_count_the_steps_of_the_optimiser(toy):
    cfg = toy("method=sd", *SETTINGS)
    train(cfg)
    saved = load(hashing.run_folder(cfg) / "last.ckpt")
    batches = saved["loops"]["fit_loop"]["epoch_loop.batch_progress"]["total"]["completed"]
    assert batches % 4 == 2, "an epoch ends within a step"
    assert saved["global_step"] == 2 * -(-batches // 4)
    assert saved["state_dict"]["method.steps"] == saved["global_step"]


@pytest.mark.parametrize("precision", ["bf16-true", "16-true"])
def test_a_mean_of_weights_in_half_precision_is_refused(toy, precision):
    """Else it stands still: 1 - 0.999 of a weight's change is less than its last bit."""
    cfg = toy("method=sd", *SETTINGS, f"trainer.precision={precision}")
    with pytest.raises(ConfigError):
        train(cfg)
