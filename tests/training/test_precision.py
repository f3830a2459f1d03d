"""`trainer.precision` of whole nets: rounds label and choose with nets of that type."""

from __future__ import annotations

import pytest
import torch

from qs3.config import hashing
from qs3.evaluation.metrics import global_features, predict
from qs3.runs.checkpoints import load
from qs3.training.command import train
from tests.training.conftest import result_of
from tests.training.nets import featured
from tests.training.watching import interrupt

SETTINGS = (
    *("method=source_only", "protocol.epochs=2", "selftraining.epochs=1"),
    *("selftraining=confident", "selftraining.share=0.5", "selection.student=infomax"),
)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_clouds_are_of_the_type_of_the_weights(dtype):
    net, points = featured(3).to(dtype), torch.randn(5, 16, 3)
    with torch.no_grad():
        logits = net.eval()(points.to(dtype)).double()
        features = net.features(points.to(dtype)).global_.double()
    torch.testing.assert_close(torch.from_numpy(predict(net, points, 5)), logits.softmax(1))
    torch.testing.assert_close(torch.from_numpy(global_features(net, points, 5)), features)


def test_such_a_run_goes_on_to_the_same_end(toy):
    """Interrupted in the first round, whose teacher's table is of the warm-up's saved weights."""
    cfg = toy(*SETTINGS, "trainer.precision=64-true")
    train(cfg)
    folder = hashing.run_folder(cfg)
    assert load(folder / "student.pt")["lift.weight"].dtype == torch.float64
    assert load(folder / "result.pt")["weights"]["lift.weight"].dtype == torch.float32
    expected = result_of(folder)
    interrupt(toy(*SETTINGS, "trainer.precision=64-true", "force=true"), "on_train_epoch_start", 3)
    train(cfg)
    assert result_of(hashing.run_folder(cfg)) == expected
