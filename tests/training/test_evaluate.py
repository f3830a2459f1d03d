"""What a run is worth: each set of weights looks at the same clouds once."""

from __future__ import annotations

import math
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from qs3.config import hashing
from qs3.evaluation.metrics import predict, predict_rotated
from qs3.runs.checkpoints import load, weights_sha256
from qs3.runs.predictions import FILE, read_predictions
from qs3.training import evaluate as stage
from qs3.training.command import train
from tests.training.toy import TinyNet

TURNS = {math.pi / 2: 1, math.pi: 1, 3 * math.pi / 2: 1}


@pytest.fixture
def passes(monkeypatch):
    """Passes of the evaluation over sets of 24 clouds, the test set's size, by their turn."""
    seen = Counter()

    def plain(net, points, *more, **named):
        seen[0.0] += len(points) == 24
        return predict(net, points, *more, **named)

    def rotated(net, points, turn, *more):
        seen[turn] += len(points) == 24
        return predict_rotated(net, points, turn, *more)

    monkeypatch.setattr(stage, "predict", plain)
    monkeypatch.setattr(stage, "predict_rotated", rotated)
    return seen


# The student, the warm-up's selected and last epochs: 3 nets. Without rounds the student is the
# last epoch. Quarter turns are those of the agreement; with rounds the warm-up's net has its own.
# With the target's norms the reported net is asked with those that it was trained with, too.
@pytest.mark.parametrize(
    ("more", "nets", "rotated"),
    [
        ((), 3, 1),
        (("selftraining=none",), 2, 1),
        (("evaluation.rotations=4",), 3, 2),
        (("selftraining=none", "evaluation.rotations=4", "evaluation.norms=adabn"), 3, 1),
        (("selftraining=none", "protocol.epochs=1"), 1, 1),
    ],
)
def test_equal_weights_predict_equal_clouds_once(toy, passes, more, nets, rotated):
    cfg = toy("force=true", *more)
    metrics = train(cfg)
    assert passes == {0.0: nets} | {turn: rotated for turn in TURNS}
    folder = hashing.run_folder(cfg)
    predictions = read_predictions(folder / FILE)
    right = (predictions.predicted == predictions.labels).mean()
    assert metrics.final.accuracy == pytest.approx(right)
    assert metrics.quality.mean_confidence == pytest.approx(predictions.probabilities.max(1).mean())


def test_weights_are_equal_by_their_values_not_by_their_file(tmp_path):
    net = TinyNet(3)
    sha = weights_sha256(net.state_dict())
    torch.save(net.state_dict(), tmp_path / "again.pt")
    assert weights_sha256(load(tmp_path / "again.pt")) == sha
    with torch.no_grad():
        before = net.lift.weight[0, 0].item()
        net.lift.weight[0, 0] = float(np.nextafter(np.float32(before), np.float32(9)))
        assert weights_sha256(net.state_dict()) != sha
        net.lift.weight[0, 0] = before
        assert weights_sha256(net.state_dict()) == sha
    assert weights_sha256({"w": torch.zeros(2, 3)}) != weights_sha256({"w": torch.zeros(3, 2)})
    assert weights_sha256({"w": torch.zeros(1)}) != weights_sha256({"v": torch.zeros(1)})


def test_nets_predict_where_they_were_trained():
    """After `fit` Lightning has moved the classifier to the CPU; the accelerator is asked."""
    trainer = SimpleNamespace(strategy=SimpleNamespace(root_device=torch.device("meta")))
    classifier = SimpleNamespace(device=torch.device("cpu"), fresh_net=lambda phase: TinyNet(3))
    run = SimpleNamespace(cfg=SimpleNamespace(data=SimpleNamespace(eval_batch_size=2)))
    loaded = SimpleNamespace(data=None, evaluation=SimpleNamespace(test=None))
    built = SimpleNamespace(trainer=trainer, classifier=classifier)
    nets = stage.SavedNets(run, loaded, built)
    assert nets.device == torch.device("meta")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_evaluation_of_a_gpus_training_is_on_the_gpu(toy, monkeypatch):
    devices = set()

    def spied(net, points, batch_size, device="cpu", **named):
        devices.add(torch.device(device).type)
        return predict(net, points, batch_size, device, **named)

    monkeypatch.setattr(stage, "predict", spied)
    train(toy("force=true", "trainer=gpu"))
    assert devices == {"cuda"}
