"""prior=: Bayes' rule by hand; shares from unlabelled clouds, the likeliest by brute force."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.classes import CLASSES
from qs3.errors import ConfigError
from qs3.evaluation.prior import ROOMS, estimate_shares, read_prior, shares_of

AB = ("a", "b")
THREE = ("chair", "table", "lamp")
shares = st.lists(st.floats(0.01, 1), min_size=3, max_size=3)


def test_bayes_rule_by_hand() -> None:
    """Trained on three a to each b, met as often as each other."""
    labels = np.array([0] * 2 + [1] * 0)  # (2 + 1) : (0 + 1), none of v is not never
    prior = read_prior({"a": 1, "b": 1}, AB, shares_of(labels, 2), power=1)
    np.testing.assert_allclose(prior.factors, [1 / 3, 1])
    # 0.6 : 0.4 becomes 0.2 : 0.4
    np.testing.assert_allclose(prior(np.array([[0.6, 0.4]])), [[1 / 3, 2 / 3]])


def test_half_of_it_by_hand() -> None:
    """The four times commoner class counts twice."""
    prior = read_prior("chair:4", THREE, power=0.5)
    assert prior.shares == pytest.approx({"chair": 4 / 6, "table": 1 / 6, "lamp": 1 / 6})
    said = prior(np.array([[0.25, 0.25, 0.5], [0.0, 0.5, 0.5]]))
    np.testing.assert_allclose(said, [[0.4, 0.2, 0.4], [0.0, 0.5, 0.5]])
    assert "at power 0.5" in prior.words
    assert prior.words.endswith("chair 66.7%, table 16.7%, lamp 16.7%")


def test_rooms_are_those_of_the_published_training_part() -> None:
    assert sum(ROOMS.values()) == 6110
    prior = read_prior("rooms", CLASSES)
    assert prior.shares["chair"] == pytest.approx(2578 / 6110)
    order = np.argsort(prior.factors)
    assert CLASSES[order[-1]] == "chair"
    assert CLASSES[order[0]] == "plant"


def test_what_never_comes_is_never_said() -> None:
    prior = read_prior("table:0", THREE, power=0.0)  # even at power 0
    said = prior(np.array([[0.2, 0.7, 0.1], [0.0, 1.0, 0.0]]))
    np.testing.assert_allclose(said, [[2 / 3, 0, 1 / 3], [0.5, 0, 0.5]])


def test_what_is_no_number_stays_none() -> None:
    said = read_prior("table:0", THREE)(np.array([[np.nan] * 3, [1.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(np.isnan(said).all(axis=1), [True, False])


@settings(max_examples=50, deadline=None)
@given(shares, shares, st.floats(0.1, 10), st.floats(0, 2))
def test_shares_whatever_the_unit_and_no_more(
    common: list[float], said: list[float], unit: float, power: float
) -> None:
    names = dict(zip(THREE, common, strict=True))
    p = np.array([said]) / np.sum(said)
    prior = read_prior(names, THREE, power=power)
    after = prior(p)
    np.testing.assert_allclose(after.sum(axis=1), 1)
    scaled = read_prior({k: unit * v for k, v in names.items()}, THREE, power=power)
    np.testing.assert_allclose(scaled(p), after, rtol=1e-6)
    # Two classes' odds change by their own ratio alone.
    odds = (after[0, 0] / after[0, 1]) / (p[0, 0] / p[0, 1])
    assert odds == pytest.approx((common[0] / common[1]) ** power, rel=1e-6)
    alike = read_prior(dict.fromkeys(THREE, unit), THREE, shares_of([0, 1, 2], 3), power)
    np.testing.assert_allclose(alike(p), p)


def test_shares_may_be_given_as_a_metrics_file_has_them():
    known = {"chair": 0.5, "table": 0.3, "lamp": 0.2}
    wanted = read_prior(known, THREE).shares
    for words in (json.dumps(known, indent=6), str(known), "{chair: .5, table: .3, lamp: .2}"):
        assert read_prior(words, THREE).shares == pytest.approx(wanted)


@pytest.mark.parametrize(
    "given",
    [
        *("chairs:4", "chair", "", "chair:4;table:2", "chair:many", "chair:-1", "chair:inf"),
        *("chair:nan", "chair:1,Chair:2", "chair:0,table:0,lamp:0", "estimated"),
    ],
)
def test_what_is_not_a_prior_is_refused(given) -> None:
    with pytest.raises(ConfigError):
        read_prior(given, THREE)


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


def test_clouds_that_tell_nothing() -> None:
    learnt = np.array([0.2, 0.5, 0.3])
    np.testing.assert_array_equal(estimate_shares(np.empty((0, 3)), learnt), learnt)
    np.testing.assert_array_equal(estimate_shares(np.full((4, 3), np.nan), learnt), learnt)
    said = said_by_bayes(ALIKE, learnt, 30, seed=0)
    with_nan = np.vstack([said, np.full((1, 3), np.nan)])
    np.testing.assert_array_equal(estimate_shares(with_nan, learnt), estimate_shares(said, learnt))
