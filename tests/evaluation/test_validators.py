"""The objective of searches: values worked by hand, properties."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.evaluation.validators import infomax


@st.composite
def tables(draw):
    """[n, K] probabilities; some of them 0, some rows equal."""
    n, k = draw(st.integers(2, 40)), draw(st.integers(2, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    p = rng.dirichlet(np.full(k, draw(st.sampled_from([0.05, 1.0, 20.0]))), size=n)
    p[rng.random(n) < 0.2] = np.eye(k)[0]
    return p


def test_infomax_by_hand():
    assert infomax(np.eye(3)) == pytest.approx(math.log(3))
    assert infomax(np.full((4, 3), 1 / 3)) == 0
    assert infomax(np.tile([1.0, 0.0, 0.0], (5, 1))) == 0  # certain, but all of one class
    # mean (3/4, 1/4): H = 0.5623; mean of the entropies: ln 2 / 2 = 0.3466
    assert infomax(np.array([[0.5, 0.5], [1.0, 0.0]])) == pytest.approx(0.2157615543)
    assert math.isnan(infomax(np.full((4, 3), np.nan)))


@given(tables(), st.randoms(use_true_random=False))
def test_its_range_and_that_order_does_not_matter(table, random):
    rows, columns = list(range(len(table))), list(range(table.shape[1]))
    random.shuffle(rows)
    random.shuffle(columns)
    assert 0 <= infomax(table) <= math.log(table.shape[1]) + 1e-12
    assert infomax(table[rows][:, columns]) == pytest.approx(infomax(table), abs=1e-9)
