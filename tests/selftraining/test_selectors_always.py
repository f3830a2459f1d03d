"""What holds for every selector, whatever the table; and naive twins."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import qs3.config.hydra  # noqa: F401 (registers the resolvers)
from qs3.config.hydra import build
from qs3.datamodules.phases import SelfTrainingConfig
from qs3.selftraining.cbst import Cbst
from qs3.selftraining.selectors import Qbst, Random, Spst, TeacherPredictions, most_confident
from qs3.utils.seeding import derive
from tests.composing import compose
from tests.selftraining.test_selectors_balanced import select
from tests.training.toy import CONF

NAMES = sorted(p.stem for p in (CONF / "selftraining").glob("*.yaml") if p.stem != "none")


# In one composition, as every process that collects the tests pays for it.
_COMPOSED = compose("train", [f"+selftraining@schemes.{name}={name}" for name in NAMES]).schemes
SCHEMES: dict[str, SelfTrainingConfig] = {name: build(_COMPOSED[name]) for name in NAMES}
SELECTORS = {name: scheme.selector for name, scheme in SCHEMES.items()} | {
    "sd": replace(SCHEMES["sd"].selector, graph=False),  # the graph needs features: test_sd
    "qbst ascending": Qbst(order="ascending"),
    "qbst of the confident": Qbst(counts="confident"),
    "cbst half": Cbst(portion=0.5),
    "lrent half": Cbst(portion=0.5, labels="lrent"),
    "random of all": Random(Qbst(), seed=3, pool="all"),
    "random cbst": Random(Cbst(portion=0.5), seed=1),
}
every_selector = pytest.mark.parametrize("name", SELECTORS)
# Whole numbers from a small range: many ties, within a row and between rows.
tables = st.lists(st.lists(st.integers(1, 9), min_size=3, max_size=3), min_size=1, max_size=40).map(
    lambda rows: np.array([[x / sum(row) for x in row] for row in rows])
)
thetas = st.sampled_from([0.0, 0.4, 0.5, 0.6, 0.8])


def ids_of(p: np.ndarray) -> list[str]:
    return [f"{i:02d}" for i in range(len(p))]


def test_all_are_here() -> None:
    assert {"qbst", "qbst_beside", "qbst_released", "spst", "cbst", "crst_mrkld", "random"} <= {
        *NAMES
    }
    assert SCHEMES["crst_mrkld"].mrkld > 0


@every_selector
@settings(max_examples=40)
@given(p=tables, theta=thetas, round_=st.integers(0, 9), rng=st.randoms(use_true_random=False))
def test_the_order_of_samples_does_not_matter(name, p, theta, round_, rng) -> None:
    """The same ids with the same labels, hard or soft, and the same figures."""
    selector = SELECTORS[name]
    ids, order = ids_of(p), rng.sample(range(len(p)), len(p))
    here, kept = select(selector, p, theta, ids, round_)
    there, kept_there = select(selector, p[order], theta, [ids[i] for i in order], round_)
    assert kept == kept_there
    assert here.selected[order].tolist() == there.selected.tolist()
    for figure in ("mu", "confident", "kept", "thresholds"):
        np.testing.assert_array_equal(getattr(here, figure), getattr(there, figure))
    if here.soft is not None:
        np.testing.assert_array_equal(here.soft[order], there.soft)


@every_selector
@settings(max_examples=40)
@given(p=tables, theta=thetas)
def test_no_pseudo_label_at_or_below_theta_and_figures_agree(name, p, theta) -> None:
    selection, _ = select(SELECTORS[name], p, theta, ids_of(p))
    labels = p.argmax(axis=1) if selection.labels is None else selection.labels
    if name not in ("random of all", "qbst_beside"):  # which have a pool or a floor beside it
        assert (p[np.arange(len(p)), labels][selection.selected] > theta).all()
    kept = np.bincount(labels[selection.selected], minlength=3)
    assert kept.tolist() == selection.kept.tolist()
    confident = np.bincount(p.argmax(axis=1)[p.max(axis=1) > theta], minlength=3)
    assert confident.tolist() == selection.confident.tolist()


SURE = {"qbst", "qbst ascending", "qbst of the confident", "random", "sd"}


@pytest.mark.parametrize("name", sorted(SURE))
def test_a_net_that_says_1_of_many_is_taken_by_what_it_doubts(name) -> None:
    """Logits 40 to 80 apart: each confidence is exactly 1, and each doubt another number."""
    rng = np.random.default_rng(0)
    gaps, k = rng.uniform(40, 80, size=120), np.repeat([0, 1, 1], 40)
    p = np.exp(-gaps)[:, None] * np.array([[0.5, 0.5, 0.5]])
    p[np.arange(120), k] = 1.0
    selection, _ = select(SELECTORS[name], p, 0.8, ids_of(p), 5)
    kept = selection.selected if name != "sd" else selection.soft.max(axis=1) == 1
    for label in (0, 1):
        of, here = gaps[k == label], kept[k == label]
        assert 0 < here.sum() < len(of)
        order = here[np.argsort(of)]  # least sure first
        if name == "random":
            assert order.tolist() not in (sorted(order), sorted(order, reverse=True))
        else:
            assert order.tolist() == sorted(order, reverse=name.endswith("ascending"))


@every_selector
def test_a_name_is_no_label(name) -> None:
    """Of clouds that tie, as many are kept of each folder of a dataset sorted by class."""
    classes = np.arange(300) % 3
    p = np.full((300, 3), 1e-30)
    p[:, 0] = 1.0
    p[:60] = [0.1, 0.85, 0.05]  # so that no mu is 0
    ids = [f"{'abc'[k]}/train/{i:03d}" for i, k in enumerate(classes)]
    selection, _ = select(SELECTORS[name], p, 0.8, ids, 5)
    kept = selection.selected if selection.soft is None else selection.soft.max(axis=1) == 1
    counts = np.bincount(classes[60:][kept[60:]], minlength=3)
    assert counts.max() <= 1.7 * counts.min() + 10


# --- QBST ------------------------------------------------------------------------------------


def qbst_by_hand(p: np.ndarray, theta: float, ids: list[str], sign: int) -> list[str]:
    """One sample after the other, in fractions; the least confident first with sign = 1."""
    above = [(i, int(row.argmax()), row) for i, row in zip(ids, p, strict=True)]
    above = [row for row in above if row[2].max() > theta]
    kept = []
    for k in range(p.shape[1]):
        of_class = sorted(
            (sign * row[k], -sign * sum(np.delete(row, k)), derive(0, "tie", i), i)
            for i, label, row in above
            if label == k
        )
        mu = 1 - Fraction(len(of_class), len(above)) if above else Fraction(0)
        kept += [f"{i}{k}" for *_, i in of_class[: math.ceil(mu * len(of_class))]]
    return sorted(kept)


@pytest.mark.parametrize(("order", "sign"), [("descending", -1), ("ascending", 1)])
@given(p=tables, theta=thetas)
def test_qbst_is_its_naive_twin(order, sign, p, theta) -> None:
    kept = select(Qbst(order=order, counts="confident"), p, theta, ids_of(p))[1]
    assert kept == " ".join(qbst_by_hand(p, theta, ids_of(p), sign))


@given(tables, thetas)
def test_qbst_of_all_counts_keeps_just_its_quota(p, theta) -> None:
    selection, _ = select(Qbst(counts="all"), p, theta, ids_of(p))
    counts, n = np.bincount(p.argmax(axis=1), minlength=3), int(selection.confident.sum())
    for k in range(3):
        mu = max(1 - Fraction(int(counts[k]), n), Fraction(0)) if n else Fraction(0)
        assert float(mu) == pytest.approx(selection.mu[k], abs=1e-12)
        assert selection.kept[k] == math.ceil(mu * int(selection.confident[k]))


@given(tables, thetas, st.sampled_from([0.2, 0.5, 1.0]))
def test_a_floor_adds_the_most_confident_of_each_predicted_class(p, theta, floor) -> None:
    teacher = TeacherPredictions.of(p, ids_of(p))
    plain, floored = Qbst().select(teacher, theta), Qbst(floor=floor).select(teacher, theta)
    least = most_confident(
        teacher.confidence, teacher.predicted, floor, ids_of(p), teacher.doubt, 1
    )
    assert floored.selected.tolist() == (plain.selected | least).tolist()
    assert ((floored.kept > 0) == (np.bincount(teacher.predicted, minlength=3) > 0)).all()


# --- SPST ------------------------------------------------------------------------------------


def test_spst_worked_by_hand() -> None:
    # theta = .6: a and d exceed it, b is just at it; c's two most probable classes tie at .5
    table = [[0.7, 0.2, 0.1], [0.6, 0.3, 0.1], [0.5, 0.5, 0.0], [0.1, 0.28, 0.62]]
    selection, kept = select(Spst(), table, 0.6)
    assert kept == "a0 d2"
    assert selection.confident.tolist() == selection.kept.tolist() == [1, 0, 1]
    assert select(Spst(), table, 0.49)[1] == "a0 b0 c0 d2"  # a tie is of the lowest class
    assert select(Spst(), table, 0.7)[1] == ""


# --- CBST ------------------------------------------------------------------------------------


def cbst_by_hand(p: np.ndarray, portion: float, ids: list[str]) -> list[str]:
    """Class after class, sample after sample."""
    thresholds = []
    for k in range(p.shape[1]):
        scores = sorted((row.max() for row in p if row.argmax() == k), reverse=True)
        rank = math.floor(Fraction(str(portion)) * len(scores))
        thresholds.append(scores[rank - 1] if rank else 1.0)
    kept = []
    for i, row in zip(ids, p, strict=True):
        quotients = [x / t for x, t in zip(row, thresholds, strict=True)]
        if max(quotients) >= 1:
            kept.append(f"{i}{quotients.index(max(quotients))}")
    return sorted(kept)


@given(tables, st.sampled_from([0.2, 0.3, 0.45, 0.5]))
def test_cbst_is_its_naive_twin(p, portion) -> None:
    kept = select(Cbst(portion=portion), p, 0.0, ids_of(p))[1]
    assert kept == " ".join(cbst_by_hand(p, portion, ids_of(p)))
