"""Validators: values worked by hand, a twin for SND with all similarities at once, properties."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.evaluation.validators import (
    LABEL_FREE,
    entropy,
    hold_out,
    infomax,
    is_better,
    snd,
)

CERTAIN = np.eye(3)
UNSURE = np.full((4, 3), 1 / 3)
ONE_CLASS = np.tile([1.0, 0.0, 0.0], (5, 1))


@st.composite
def tables(draw, least=2):
    """[n, K] probabilities; some of them 0, some rows equal."""
    n, k = draw(st.integers(least, 40)), draw(st.integers(2, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    p = rng.dirichlet(np.full(k, draw(st.sampled_from([0.05, 1.0, 20.0]))), size=n)
    p[rng.random(n) < 0.2] = np.eye(k)[0]
    return p


def snd_of_all(p, temperature=0.05):
    """All n x n similarities at once, row by row as the formula is written."""
    f = [row / math.sqrt(sum(row * row)) for row in p]
    values = []
    for i in range(len(p)):
        e = [math.exp(float(f[i] @ f[j]) / temperature) for j in range(len(p)) if j != i]
        q = [x / sum(e) for x in e]
        values.append(-sum(x * math.log(x) for x in q if x > 0))
    return sum(values) / len(values)


def test_entropy_by_hand():
    assert entropy(CERTAIN) == 0
    assert entropy(UNSURE) == pytest.approx(math.log(3))
    assert entropy(np.array([[0.5, 0.5, 0.0], [1.0, 0.0, 0.0]])) == pytest.approx(math.log(2) / 2)
    quarter = -(0.25 * math.log(0.25) + 0.75 * math.log(0.75))
    assert entropy(np.array([[0.25, 0.75]])) == pytest.approx(quarter)


@pytest.mark.parametrize("name", LABEL_FREE)
def test_a_net_that_has_diverged_has_no_score(name):
    assert math.isnan(LABEL_FREE[name].score(np.full((4, 3), np.nan)))


def test_infomax_by_hand():
    assert infomax(CERTAIN) == pytest.approx(math.log(3))
    assert infomax(UNSURE) == 0
    assert infomax(ONE_CLASS) == 0  # where the entropy alone is at its best
    # mean (3/4, 1/4): H = 0.5623; mean of the entropies: ln 2 / 2 = 0.3466
    assert infomax(np.array([[0.5, 0.5], [1.0, 0.0]])) == pytest.approx(0.2157615543)


def test_snd_by_hand():
    assert snd(CERTAIN) == pytest.approx(math.log(2))  # two neighbours, both at a right angle
    assert snd(ONE_CLASS) == pytest.approx(math.log(4))
    assert snd(np.array([[1.0, 0.0], [0.0, 1.0]])) == 0  # one neighbour, whatever it is like
    # two pairs: each cloud has one neighbour at 1 and two at 0: weights 1, e^-20, e^-20
    pairs = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    small = math.exp(-20)
    z = 1 + 2 * small
    assert snd(pairs) == pytest.approx(math.log(z) + 2 * small * 20 / z, rel=1e-6)
    assert snd(pairs, temperature=1.0) == pytest.approx(  # weights e, 1, 1
        math.log(math.e + 2) - math.e / (math.e + 2)
    )


@given(tables(), st.integers(1, 50))
def test_snd_in_blocks_is_snd_of_all(table, block):
    assert snd(table, block=block) == pytest.approx(snd_of_all(table), abs=1e-9)


@given(tables(), st.randoms(use_true_random=False))
def test_order_of_clouds_and_classes_does_not_matter(table, random):
    rows, columns = list(range(len(table))), list(range(table.shape[1]))
    random.shuffle(rows)
    random.shuffle(columns)
    for name, validator in LABEL_FREE.items():
        moved = validator.score(table[rows][:, columns])
        assert moved == pytest.approx(validator.score(table), abs=1e-9), name


@given(tables())
def test_ranges(table):
    n, k = table.shape
    top = math.log(k) + 1e-12
    assert 0 <= entropy(table) <= top
    assert 0 <= infomax(table) <= top
    assert 0 <= snd(table) <= math.log(n - 1)


@pytest.mark.parametrize(
    ("rule", "scores", "best"),
    [
        ("entropy", [0.5, 0.3, 0.3, 0.4], 1),
        ("infomax", [0.5, 0.7, 0.7, 0.6], 1),
        ("snd", [2.0, 1.0], 0),
        ("pseudo_val", [0.5, 0.5, 0.9], 2),
        ("entropy", [math.nan, 0.6, math.nan, 0.5], 3),
        ("snd", [math.nan, math.nan], 0),
    ],
)
def test_the_best_and_the_earliest_of_them(rule, scores, best):
    chosen, value = -1, None
    for i, score in enumerate(scores):
        if is_better(rule, score, value):
            chosen, value = i, score
    assert chosen == best


@given(
    st.lists(st.integers(0, 4), min_size=1, max_size=80),
    st.integers(0, 2**63 - 1),
    st.randoms(use_true_random=False),
)
def test_held_out_part(labels, seed, random):
    y = np.array(labels)
    ids = [f"cloud/{i}" for i in range(len(y))]
    held = hold_out(y, ids, seed)
    all_, out = np.bincount(y, minlength=5), np.bincount(y[held], minlength=5)
    assert (np.abs(out - all_ / 5) <= 0.5).all()
    assert ((out < all_) | (all_ == 0)).all()  # something of each class is left to train on
    order = list(range(len(y)))
    random.shuffle(order)
    again = hold_out(y[order], [ids[i] for i in order], seed)
    assert (again == held[order]).all()
