"""Schedules, smoothing, regulariser and precision in a training."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F

from qs3.config.hydra import run_folder
from qs3.datamodules.phases import Phases
from qs3.engine.classifier import Classifier
from qs3.evaluation.metrics import global_features, predict
from qs3.methods.base import class_loss
from qs3.methods.bounds import SourceOnly
from qs3.models.pointnet import pointnet, transform_regulariser
from qs3.runs.checkpoints import load
from qs3.selftraining.student import Student
from qs3.training.command import train
from tests.training.nets import featured


def test_smoothing_spreads_over_the_other_classes():
    logits, labels = torch.randn(5, 4, dtype=torch.float64), torch.tensor([0, 3, 1, 1, 2])
    target = torch.full((5, 4), 0.2 / 3, dtype=torch.float64)
    target[torch.arange(5), labels] = 0.8
    by_hand = -(target * logits.log_softmax(1)).sum(1).mean()
    torch.testing.assert_close(class_loss(logits, labels, 0.2), by_hand)
    torch.testing.assert_close(class_loss(logits, F.one_hot(labels, 4).double(), 0.2), by_hand)
    torch.testing.assert_close(class_loss(logits, labels), F.cross_entropy(logits, labels))


def test_the_nets_regulariser_is_added():
    torch.manual_seed(0)
    classifier = Classifier(
        lambda: pointnet(4, variant="simpleview", dropout=0.0),
        torch.optim.Adam,
        SourceOnly(),
        Student(),
        Phases(1),
        seed=0,
        regulariser_weight=0.001,
    )
    classifier.log = lambda *args, **kwargs: None  # type: ignore[method-assign]
    points, labels = torch.randn(6, 32, 3), torch.tensor([0, 1, 2, 3, 0, 1])
    batch = {"source": {"points": points, "y_source": labels}}
    features = classifier.net.features(points)
    classifier._regularisers.clear()
    plain = SourceOnly().loss(classifier.net, batch, torch.Generator())["ce"]
    assert len(classifier._regularisers) == 1  # one pass
    torch.testing.assert_close(classifier._regularisers[0], features.regulariser)
    assert features.regulariser > 0
    assert plain > 0
    assert transform_regulariser(torch.eye(3)[None]) == 0


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_clouds_are_of_the_type_of_the_weights(dtype):
    net, points = featured(3).to(dtype), torch.randn(5, 16, 3)
    with torch.no_grad():
        logits = net.eval()(points.to(dtype)).double()
        features = net.features(points.to(dtype)).global_.double()
    torch.testing.assert_close(torch.from_numpy(predict(net, points, 5)), logits.softmax(1))
    torch.testing.assert_close(torch.from_numpy(global_features(net, points, 5)), features)


FEATURED = "model._target_=tests.training.nets.featured"
# Each epoch 15 batches of 4 clouds of 60: its last step is of one batch.
SETTINGS = (
    *(FEATURED, "protocol.epochs=2", "protocol.batch_size=4", "selftraining=none"),
    *("+trainer.accumulate_grad_batches=2", "paths.warmup_dir=null"),
)


def test_means_count_the_steps_of_the_optimiser(toy):
    cfg = toy("method=sd", *SETTINGS)
    train(cfg)
    saved = load(run_folder(cfg) / "last.ckpt")
    batches = saved["loops"]["fit_loop"]["epoch_loop.batch_progress"]["total"]["completed"]
    assert batches % 4 == 2, "an epoch ends within a step"
    assert saved["global_step"] == 2 * -(-batches // 4)
    assert saved["state_dict"]["method.steps"] == saved["global_step"]
