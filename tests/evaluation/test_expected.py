"""The estimate of accuracy without labels: known answers, and what it never does."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.evaluation.unlabelled import (
    FEWEST,
    WEIGHT,
    HeldOut,
    expected_accuracy,
    held_out,
    in_words,
    scaled,
    temperature,
)


def sure(share: float, n: int = FEWEST) -> np.ndarray:
    """Answers of two classes with this confidence each."""
    return np.tile([share, 1 - share], (n, 1))


def test_the_formula_by_hand() -> None:
    """A net that is right about 80 % is 60 % sure: ln 4 - w (ln 4 - ln 1.5)."""
    found = expected_accuracy(HeldOut(0.8, 1.0), sure(0.6))
    z = math.log(4) - WEIGHT * (math.log(4) - math.log(1.5))
    assert found == pytest.approx(1 / (1 + math.exp(-z)))
    assert in_words(found) == "about 42% expected right (±11)"


def test_of_few_and_of_a_net_that_diverged_nothing_is_said() -> None:
    known = HeldOut(0.8, 1.0)
    assert expected_accuracy(known, sure(0.6, FEWEST - 1)) is None
    assert expected_accuracy(None, sure(0.6)) is None
    assert expected_accuracy(known, sure(float("nan"))) is None
    assert held_out(np.full((3, 2), np.nan), np.zeros(3, int)) is None
    assert in_words(None) == ""


def test_held_out_counts_one_more_of_each() -> None:
    known = held_out(sure(0.9, 8), np.zeros(8, int))
    assert known.accuracy == pytest.approx(9 / 10)


@given(st.integers(0, 100), st.integers(1, 40), st.integers(2, 5))
def test_the_temperature_is_the_best_on_a_grid(seed: int, n: int, classes: int) -> None:
    rng = np.random.default_rng(seed)
    p, labels = rng.dirichlet(np.ones(classes), size=n), rng.integers(classes, size=n)
    weights = np.full(p.shape, 1 / (n + 2) / (classes - 1))
    weights[np.arange(n), labels] = 1 - 1 / (n + 2)

    def loss(t: float) -> float:
        return -float((weights * np.log(np.maximum(scaled(p, t), 1e-300))).sum())

    found = temperature(p, labels)
    assert 0.05 <= found <= 20
    assert all(loss(found) <= loss(t) + 1e-4 * n for t in np.geomspace(0.05, 20, 60))
