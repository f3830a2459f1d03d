"""The domain classifier of the calibration: by loops, known answers, and what it must not do."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from qs3.errors import DataError
from qs3.selftraining.pcfea import penultimate
from tests.methods.shapes import tiny_net

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(not (ROOT / ".ci").is_dir(), reason="an sdist has none of it")
if (ROOT / ".ci").is_dir():
    sys.path.append(str(ROOT / ".ci"))
    import trust_domain as td


def sides(m: int, n: int, d: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(m, d)), rng.normal(size=(n, d))


def test_auc_by_pairs():
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 5, 13).astype(float), rng.integers(1, 6, 7).astype(float)
    pairs = [(b > a) + 0.5 * (a == b) for a in first for b in second]
    assert td.auc(first, second) == pytest.approx(sum(pairs) / len(pairs))
    assert td.auc(second, second) == 0.5
    assert td.auc(np.arange(3.0), np.arange(3.0, 9.0)) == 1.0


@pytest.mark.parametrize(("n", "d"), [(40, 3), (6, 20)])
def test_shrinkage_by_loops(n, d):
    """With more columns than rows, too, it can be inverted."""
    rows = np.random.default_rng(1).normal(size=(n, d)) * np.linspace(1, 3, d)
    rows -= rows.mean(axis=0)
    covariance = sum(np.outer(x, x) for x in rows) / n
    target = np.eye(d) * np.trace(covariance) / d
    noise = sum(((np.outer(x, x) - covariance) ** 2).sum() for x in rows) / n**2
    far = ((covariance - target) ** 2).sum()
    a = min(1.0, noise / far)
    found = td.shrunk(rows)
    np.testing.assert_allclose(found, (1 - a) * covariance + a * target)
    assert np.linalg.eigvalsh(found).min() > 0


def test_the_direction_is_fisher_s():
    """Of many rows: the inverse covariance times the difference of the means."""
    rng = np.random.default_rng(2)
    mix = np.array([[2.0, 0.0], [1.5, 0.5]])
    first, second = (rng.normal(size=(20000, 2)) @ mix.T + at for at in ([0, 0], [1.0, 0.0]))
    expected = np.linalg.solve(mix @ mix.T, [1.0, 0.0])
    found = td.discriminant(first, second)
    np.testing.assert_allclose(found / found[0], expected / expected[0], atol=0.05)


@pytest.mark.parametrize("d", [4, 300])
def test_chance_is_near_0_however_many_columns(d):
    """It is judged on clouds that it was not fitted on: those it could learn by heart."""
    found = [td.told_apart(*sides(60, 80, d, seed)) for seed in range(8)]
    assert np.mean(found) < 0.15
    assert max(found) < 0.4


def test_a_shift_of_one_column_among_many_is_found():
    first, second = sides(100, 150, 200)
    second[:, 7] += 8
    assert td.told_apart(first, second) > 0.95
    assert td.told_apart(second, first) > 0.95  # whichever is the target
    weak = second.copy()
    weak[:, 7] -= 6
    assert 0.2 < td.told_apart(first, weak) < td.told_apart(first, second)


def test_units_do_not_matter_and_dead_columns_do_no_harm():
    first, second = sides(50, 50, 6)
    second[:, 0] += 1
    before = td.told_apart(first, second)
    units = np.array([1e-3, 1, 1e3, 1, 1, 0.0])
    without = td.told_apart(first[:, :5], second[:, :5])
    assert td.told_apart(first * units, second * units) == pytest.approx(without, abs=0.05)
    assert before > 0.3
    assert td.told_apart(np.zeros((20, 3)), np.zeros((20, 3))) == 0


def test_the_last_layer_s_input_in_eval_mode():
    net, points = tiny_net(), torch.randn(70, 16, 3)
    net.train()
    found = td.last_inputs(net, points)
    assert net.training
    with torch.no_grad():
        expected, _ = penultimate(net.eval(), points)
    assert found.shape == (70, 32)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert not net.head[-1]._forward_pre_hooks


def test_what_is_refused():
    with pytest.raises(DataError, match="9 and 50 clouds: at least 10 of each"):
        td.told_apart(*sides(9, 50, 2))
    with pytest.raises(DataError, match="Flatten has no linear layer"):
        td.last_inputs(nn.Flatten(), torch.zeros(2, 4, 3))
    with pytest.raises(DataError, match="no last linear layer of one vector a cloud"):
        td.last_inputs(nn.Linear(3, 2), torch.zeros(2, 4, 3))
