from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from qs3.datamodules.clouds import Clouds
from qs3.evaluation.metrics import (
    Evaluation,
    calibration_error,
    predict,
    scores,
)


def test_scores_worked_by_hand():
    labels = np.array([0, 0, 0, 0, 1, 1])
    said = np.eye(3)[[0, 0, 0, 1, 1, 0]] * 0.7 + 0.1
    result = scores(said, labels, ("a", "b", "c"))
    assert result.accuracy == pytest.approx(4 / 6)
    assert result.balanced_accuracy == pytest.approx((3 / 4 + 1 / 2) / 2)
    assert result.per_class_recall == {"a": 0.75, "b": 0.5, "c": None}
    assert result.confusion == [[3, 1, 0], [1, 1, 0], [0, 0, 0]]
    assert result.majority_rate == pytest.approx(4 / 6)
    assert result.n == 6
    assert result.predicted == {"a": 4, "b": 2, "c": 0}
    assert result.calibration_error == pytest.approx(0.8 - 4 / 6)


def test_a_net_that_has_diverged_has_scores_but_is_not_calibrated():
    result = scores(np.full((4, 2), np.nan), np.array([0, 0, 0, 1]), ("a", "b"))
    assert (result.accuracy, result.calibration_error) == (0.75, None)


@given(st.integers(0, 1000), st.integers(1, 30), st.integers(2, 5), st.integers(1, 20))
def test_calibration_against_bin_by_bin(seed, n, k, bins):
    rng = np.random.default_rng(seed)
    probabilities = rng.dirichlet(np.ones(k), size=n)
    labels = rng.integers(k, size=n)
    confidence, right = probabilities.max(axis=1), probabilities.argmax(axis=1) == labels
    expected = 0.0
    for b in range(bins):
        inside = (confidence > b / bins) & (confidence <= (b + 1) / bins)
        if inside.any():
            expected += inside.mean() * abs(right[inside].mean() - confidence[inside].mean())
    assert calibration_error(probabilities, labels, bins) == pytest.approx(expected)


def test_prediction_is_deterministic_and_leaves_the_mode_alone():
    net = nn.Sequential(nn.Flatten(), nn.Linear(6, 3), nn.Dropout(0.5))
    points = torch.rand(5, 2, 3)
    net.train()
    first = predict(net, points, 2)
    assert net.training
    assert np.array_equal(first, predict(net, points, 2))
    assert np.allclose(first.sum(axis=1), 1)


@pytest.mark.parametrize("labelled", [True, False])
@pytest.mark.parametrize("tiers", [{"a": "clean", "b": "hard", "d": "clean"}, {}, None])
def test_each_tier_is_scored_by_itself(labelled, tiers):
    clouds = Clouds.of(np.zeros((4, 6, 3), np.float32), names=tuple("abcd"))
    labels = torch.tensor([0, 1, 0, 1]) if labelled else None
    evaluation = Evaluation(clouds, labels, None, ("x", "y"), tiers=tiers)
    p = np.array([[0.9, 0.1], [0.8, 0.2], [0.4, 0.6], [0.3, 0.7]], np.float32)
    of_each = evaluation.predictions_of(p).tiers
    assert of_each == (("clean", "hard", "", "clean") if tiers else ())
    found = evaluation.scores_of_tiers(p)
    if not (labelled and tiers):
        assert found is None
        return
    assert {tier: (s.n, s.accuracy) for tier, s in found.items()} == {
        "clean": (2, 1.0),  # a and d; c has none
        "hard": (1, 0.0),
    }
