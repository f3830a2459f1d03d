from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from qs3.evaluation import figures, predict


def test_figures_worked_by_hand():
    labels = np.array([0, 0, 0, 0, 1, 1])
    predicted = np.array([0, 0, 0, 1, 1, 0])
    result = figures(predicted, labels, ("a", "b", "c"))
    assert result["accuracy"] == pytest.approx(4 / 6)
    assert result["balanced_accuracy"] == pytest.approx((3 / 4 + 1 / 2) / 2)
    assert result["per_class_recall"] == {"a": 0.75, "b": 0.5, "c": None}
    assert result["confusion"] == [[3, 1, 0], [1, 1, 0], [0, 0, 0]]
    assert result["majority_rate"] == pytest.approx(4 / 6)
    assert result["n"] == 6


def test_prediction_is_deterministic_and_leaves_the_mode_alone():
    net = nn.Sequential(nn.Flatten(), nn.Linear(6, 3), nn.Dropout(0.5))
    points = torch.rand(5, 2, 3)
    net.train()
    first = predict(net, points, 2)
    assert net.training
    assert np.array_equal(first, predict(net, points, 2))
    assert np.allclose(first.sum(axis=1), 1)
