"""What a run is worth: each set of weights looks at the same clouds once."""

from __future__ import annotations

import math
from collections import Counter

import pytest

from qs3.config import hashing
from qs3.evaluation.metrics import predict, predict_rotated
from qs3.runs.predictions import FILE, read_predictions
from qs3.training import evaluate as stage
from qs3.training.command import train

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
# last epoch. With the target's norms the reported net is asked with those that it was trained with,
# too.
@pytest.mark.parametrize(
    ("more", "nets", "rotated"),
    [
        (("evaluation.rotations=4",), 3, 2),
        (("selftraining=none", "evaluation.rotations=4", "evaluation.norms=adabn"), 3, 1),
        (("selftraining=none", "protocol.epochs=1"), 1, 0),
    ],
)
def test_equal_weights_predict_equal_clouds_once(toy, passes, more, nets, rotated):
    cfg = toy("force=true", *more)
    metrics = train(cfg)
    assert +passes == {0.0: nets} | ({turn: rotated for turn in TURNS} if rotated else {})
    folder = hashing.run_folder(cfg)
    predictions = read_predictions(folder / FILE)
    right = (predictions.predicted == predictions.labels).mean()
    assert metrics.final.accuracy == pytest.approx(right)
