"""Shares of classes from unlabelled clouds: known answers, and the likeliest by brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.evaluation.share_estimates import estimate_shares

ALIKE = np.full(3, 1 / 3)


def said_by_bayes(shares: np.ndarray, learnt: np.ndarray, n: int, seed: int) -> np.ndarray:
    """What a perfect net, trained on `learnt`, says of n clouds of these shares.

    Three classes, each a normal distribution on a line.
    """
    rng = np.random.default_rng(seed)
    x = rng.choice(3, n, p=shares) * 2.0 + rng.normal(size=n)
    told = learnt * np.exp(-((x[:, None] - np.arange(3) * 2.0) ** 2) / 2)
    return told / told.sum(axis=1, keepdims=True)


def objective(q: np.ndarray, p: np.ndarray, learnt: np.ndarray, t: float, m: float) -> float:
    explains = (p / learnt) ** (1 / t)
    return float(np.log(explains @ q).sum() + m * np.log(q).sum())


@pytest.mark.parametrize("learnt", [ALIKE, np.array([0.2, 0.5, 0.3])])
def test_a_net_that_is_as_sure_as_it_is_right_tells_the_shares(learnt: np.ndarray) -> None:
    """Up to what 20,000 clouds leave to chance; its own mean is far from them."""
    shares = np.array([0.7, 0.1, 0.2])
    said = said_by_bayes(shares, learnt, 20_000, seed=0)
    found = estimate_shares(said, learnt, temperature=1.0, more=0.0)
    np.testing.assert_allclose(found, shares, atol=0.01)
    assert np.abs(said.mean(axis=0) - shares).max() > 0.05


@pytest.mark.parametrize(("temperature", "more"), [(1.0, 0.5), (2.0, 5.0), (0.7, 0.1)])
def test_no_other_shares_are_likelier(temperature: float, more: float) -> None:
    learnt = np.array([0.2, 0.5, 0.3])
    said = said_by_bayes(np.array([0.6, 0.3, 0.1]), learnt, 50, seed=1)
    found = estimate_shares(said, learnt, temperature, more)
    best = objective(found, said, learnt, temperature, more)
    grid = np.arange(1, 100) / 100
    others = [np.array([a, b, 1 - a - b]) for a in grid for b in grid if a + b < 0.995]
    assert all(objective(q, said, learnt, temperature, more) <= best for q in others)
    nudged = found + np.array([1e-4, -1e-4, 0])
    assert objective(nudged, said, learnt, temperature, more) < best


def test_one_cloud_by_hand() -> None:
    """q_0 = (r + m) / (1 + 2 m) with r = 4 q_0 / (4 q_0 + q_1), here m = 1."""
    (first, second) = estimate_shares(
        np.array([[0.8, 0.2]]), np.array([0.5, 0.5]), temperature=1.0, more=1.0
    )
    right = 4 * first / (4 * first + second)
    assert first == pytest.approx((right + 1) / 3, abs=1e-6)
    assert first + second == pytest.approx(1)


def test_a_class_that_is_never_said_stays_possible() -> None:
    said = np.tile([1.0, 0.0, 0.0], (100, 1))
    found = estimate_shares(said, ALIKE)
    np.testing.assert_allclose(found, [105 / 115, 5 / 115, 5 / 115], atol=1e-6)


def test_clouds_that_tell_nothing() -> None:
    learnt = np.array([0.2, 0.5, 0.3])
    np.testing.assert_array_equal(estimate_shares(np.empty((0, 3)), learnt), learnt)
    np.testing.assert_array_equal(estimate_shares(np.full((4, 3), np.nan), learnt), learnt)
    said = said_by_bayes(ALIKE, learnt, 30, seed=0)
    with_nan = np.vstack([said, np.full((1, 3), np.nan)])
    np.testing.assert_array_equal(estimate_shares(with_nan, learnt), estimate_shares(said, learnt))


@given(
    st.lists(
        st.lists(st.floats(0, 1), min_size=3, max_size=3).filter(lambda row: sum(row) > 0),
        max_size=8,
    )
)
@settings(max_examples=50, deadline=None)
def test_shares_whatever_a_net_says(rows: list[list[float]]) -> None:
    said = np.array(rows).reshape(-1, 3)
    said = said / said.sum(axis=1, keepdims=True)
    found = estimate_shares(said, ALIKE)
    assert (found > 0).all()
    assert found.sum() == pytest.approx(1)
    order = np.random.default_rng(0).permutation(3)  # classes have no order
    np.testing.assert_allclose(estimate_shares(said[:, order], ALIKE), found[order], atol=1e-7)
