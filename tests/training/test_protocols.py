"""Schedules, label smoothing and a net's own regulariser, as a protocol sets them."""

from __future__ import annotations

import csv

import pytest
import torch
from torch.nn import functional as F

from qs3.config import hashing
from qs3.datamodules.phases import Phases
from qs3.engine.classifier import Classifier
from qs3.methods.base import class_loss
from qs3.methods.bounds import SourceOnly
from qs3.models.pointnet import pointnet, transform_regulariser
from qs3.selftraining.student_selection import Student
from qs3.training.command import train
from tests.training.conftest import result_of
from tests.training.watching import interrupt


def test_smoothing_spreads_over_the_other_classes():
    logits, labels = torch.randn(5, 4, dtype=torch.float64), torch.tensor([0, 3, 1, 1, 2])
    target = torch.full((5, 4), 0.2 / 3, dtype=torch.float64)
    target[torch.arange(5), labels] = 0.8
    by_hand = -(target * logits.log_softmax(1)).sum(1).mean()
    torch.testing.assert_close(class_loss(logits, labels, 0.2), by_hand)
    torch.testing.assert_close(class_loss(logits, F.one_hot(labels, 4).double(), 0.2), by_hand)
    torch.testing.assert_close(class_loss(logits, labels), F.cross_entropy(logits, labels))


SIMPLEVIEW = ("protocol=simpleview", "protocol.epochs=40", "protocol.optimizer.lr=4.0")


def column(folder, name) -> list[float]:
    with open(folder / "history.csv", newline="") as file:
        return [float(row[name]) for row in csv.DictReader(file)]


@pytest.mark.slow
def test_a_run_with_a_plateau_resumes_exactly(toy):
    cfg = toy(*SIMPLEVIEW)
    train(cfg)
    rates, expected = column(hashing.run_folder(cfg), "lr"), result_of(hashing.run_folder(cfg))
    assert rates[0] == 4.0
    assert rates[39] < 4.0  # it came to a plateau
    assert rates[40:] == [4.0] * 6  # each round begins anew
    again = toy(*SIMPLEVIEW, "force=true")
    interrupt(again, "on_train_batch_end", 78)  # in the warm-up
    train(toy(*SIMPLEVIEW))
    assert result_of(hashing.run_folder(cfg)) == expected


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
