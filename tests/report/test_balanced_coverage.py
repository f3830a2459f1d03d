"""What is said of intervals of balanced accuracy (docs/explanation/decisions.md) is so."""

import numpy as np
import pytest

from qs3.report.clustered import weights
from qs3.report.judge.intervals import difference, share
from qs3.report.tables.paired import interval
from tests.report.balanced_coverage import DESIGNS, coverage, ends, rows


def test_few_rooms():
    """Of 400 intervals; the standard error of a share of 95 % is 1 %."""
    ((mean, recalls, _), (_, plain, corrected)), _ = coverage(DESIGNS[1], seeds=5)
    assert 0.92 <= mean <= 0.985
    assert recalls < mean - 0.02
    assert plain + 0.02 < corrected


def test_its_ways_are_those_of_the_commands():
    rng = np.random.default_rng(0)
    label, room = DESIGNS[1].labels(rng)
    a, b = rows(rng, DESIGNS[1], 3, label, room)
    mean, _, _ = ends(a.astype(float) - b, label, room)
    _, _, corrected = ends(a.astype(float), label, room)
    compared = interval(a.astype(float) - b, weights(label, True), room)
    assert mean == pytest.approx((compared.low, compared.high))
    judged = difference(a, b, label, room, balanced=True)
    assert mean == pytest.approx((judged.low, judged.high))
    judged = share(a, label, room, balanced=True)
    assert corrected == pytest.approx((judged.low, judged.high))
