"""prior=: Bayes' rule by hand, what a choice of it cannot do, and where it shows."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.classes import CLASSES, MODELNET40
from qs3.errors import ConfigError
from qs3.evaluation.prior import ROOMS, check_told, read_prior, shares_of
from tests.composing import compose

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


def test_what_only_a_run_can_estimate_is_refused_elsewhere() -> None:
    with pytest.raises(ConfigError, match=r"prior=estimated is for a run.* prior=chair:4,table:2"):
        read_prior("estimated", THREE)
    with pytest.raises(ConfigError, match=r"or say evaluation\.prior=rooms, or estimated"):
        read_prior("estimate", THREE, key="evaluation.prior")


def test_half_of_it_by_hand() -> None:
    """The four times commoner class counts twice."""
    prior = read_prior("chair:4", THREE, power=0.5)
    np.testing.assert_allclose(prior.shares, [4 / 6, 1 / 6, 1 / 6])
    said = prior(np.array([[0.25, 0.25, 0.5], [0.0, 0.5, 0.5]]))
    np.testing.assert_allclose(said, [[0.4, 0.2, 0.4], [0.0, 0.5, 0.5]])
    assert "at power 0.5" in prior.words
    assert prior.words.endswith("chair 66.7%, table 16.7%, lamp 16.7%")


def test_rooms_are_those_of_the_published_training_part() -> None:
    assert sum(ROOMS.values()) == 6110
    prior = read_prior("rooms", CLASSES)
    assert prior.shares[CLASSES.index("chair")] == pytest.approx(2578 / 6110)
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


def test_huge_numbers_and_powers_are_finite() -> None:
    """The largest floats, and a power by which the commonest class alone is left."""
    prior = read_prior(dict.fromkeys(THREE, 1.7e308), THREE, power=1.0)
    np.testing.assert_allclose(prior.shares, 1 / 3)
    alone = read_prior("chair:2", THREE, power=1e300)
    np.testing.assert_array_equal(alone(np.array([[0.01, 0.5, 0.49], [0, 0.5, 0.5]]))[0], [1, 0, 0])
    assert np.isfinite(alone(np.array([[0, 0.5, 0.5]]))).all()
    many = read_prior("chair:9", MODELNET40)
    assert many.words.endswith(", and 28 more")


def test_names_are_those_that_folders_may_have() -> None:
    given = read_prior("Night_Stand:2,couch:3", CLASSES)
    plain = read_prior({"cabinet": 2, "sofa": 3}, CLASSES)
    np.testing.assert_array_equal(given.factors, plain.factors)


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
        np.testing.assert_allclose(read_prior(words, THREE).shares, wanted)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("chairs:4", "prior=chairs: the classifier's classes are chair, table, lamp"),
        ("chair", "'chair' should be CLASS:NUMBER"),
        ("{chair:4", "prior={chair: the classifier's classes are chair"),
        ("", "'' should be CLASS:NUMBER"),
        ("chair:4;table:2", "'4;table' after chair|CLASS:NUMBER|classes are"),
        ("chair:many", "'many' after chair should be a number"),
        ("chair:-1", "prior=chair must be >= 0"),
        ("chair:inf", "prior=chair must be"),
        ("chair:nan", "prior=chair must be"),
        ("chair:1,Chair:2", "names chair twice"),
        ("chair:0,table:0,lamp:0", "leaves no class"),
        ({"chair": True}, "prior=chair must be a number"),
        (["chair"], "should be words or a mapping"),
    ],
)
def test_what_is_no_prior_says_so(given, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_prior(given, THREE)


@pytest.mark.parametrize("key", ["prior", "evaluation.prior"])
@pytest.mark.parametrize(
    "wrong",
    [
        lambda key: check_told(None, 0.7, key),
        lambda key: read_prior("chair", THREE, key=key),
        lambda key: read_prior("rooms", (*THREE, "crate"), key=key),
    ],
)
def test_what_is_advised_is_a_prior(key, wrong) -> None:
    """Typed as it stands, in the grammar of the command that it is for."""
    with pytest.raises(ConfigError) as told:
        wrong(key)
    if key == "prior":
        (words,) = re.findall(r"prior=([a-z]+:\S+:\d)", str(told.value))
        given: Any = words
    else:
        (words,) = re.findall(r"'evaluation.prior=([^']+)'", str(told.value))
        given = dict(compose("train", [f"evaluation.prior={words}"]).evaluation.prior)
    assert read_prior(given, THREE).shares == pytest.approx([4 / 7, 2 / 7, 1 / 7])


def test_rooms_know_ten_classes() -> None:
    with pytest.raises(ConfigError, match="the classifier also tells shelf_unit: say how common"):
        read_prior("rooms", ("chair", "shelf_unit"))
    assert read_prior("rooms", ("chair", "lamp")).shares[0] == pytest.approx(2578 / 2739)
    with pytest.raises(ConfigError, match="prior_power must be >= 0"):
        read_prior("rooms", CLASSES, power=-1)
