"""The winner among scores and the correlation, by compiled loops and by numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.sensors.matching import NormalisedCorrelation, ReferenceMatcher
from qs3.sensors.matching import correlation as scores
from qs3.sensors.matching.correlation import correlation, winner
from tests.sensors.matching.textures import dots, seen

FIELDS = ("place", "top", "lower", "upper", "second")


@given(st.integers(3, 70), st.integers(1, 5), st.integers(1, 70), st.integers(0, 2**32 - 1))
def test_both_ways_find_the_same_winner(count, height, width, seed):
    rng = np.random.default_rng(seed)
    some = rng.standard_normal((count, height, width)).astype(np.float32)
    some[rng.random(some.shape) < 0.3] = -1  # outside the other image
    compiled, plain = winner(some), scores._winner_by_numpy(some)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(compiled, name), getattr(plain, name))


def test_the_correlation_is_numpys_to_the_bit():
    """Of parts of larger arrays, as the matcher hands them over."""
    rng = np.random.default_rng(0)
    product, mean_a, mean_b, spread_a, spread_b = rng.random((5, 40, 90)).astype(np.float32) + 0.01
    here, there = np.s_[:, 3:71], np.s_[:, 10:78]
    out = np.zeros((40, 90), np.float32)
    correlation(
        product[here], (mean_a[here], mean_b[there]), (spread_a[here], spread_b[there]), out[here]
    )
    covariance = product[here] - mean_a[here] * mean_b[there]
    np.testing.assert_array_equal(out[here], covariance / (spread_a[here] * spread_b[there]))
    assert not out[:, :3].any()
    assert not out[:, 71:].any()


@pytest.mark.parametrize("matcher", [ReferenceMatcher(), NormalisedCorrelation()])
@pytest.mark.parametrize("first", [-20, 0, 60, 200])
def test_a_match_does_not_depend_on_numba(matcher, first, monkeypatch):
    """To the bit, also where a part of the search, or all of it, lies outside the other image."""
    texture = dots(40, 300, seed=3)
    reference, image = seen(texture, 0.0).astype(np.float32), seen(texture, 4.3)[:, 60:200]
    found = matcher.match(image, reference, first)
    monkeypatch.setattr(scores, "has_numba", lambda: False)
    plain = matcher.match(image, reference, first)
    np.testing.assert_array_equal(found.disparity, plain.disparity)
    np.testing.assert_array_equal(found.reason, plain.reason)
