"""The winner among scores and the correlation, by compiled loops and by numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from qs3.sensors.matching.scores import correlation, winner

from qs3.sensors.matching import NormalisedCorrelation, ReferenceMatcher
from qs3.sensors.matching import correlation as scores
from tests.sensors.matching.textures import dots, seen

FIELDS = ("place", "top", "lower", "upper", "second")


@pytest.fixture(params=["compiled", "numpy"])
def way(request, monkeypatch):
    if request.param == "numpy":
        monkeypatch.setattr(scores, "has_numba", lambda: False)
    return request.param


@pytest.mark.parametrize("count", [3, 4, 5, 6, 7, 64])
def test_the_winner_is_that_of_a_plain_search(way, count):
    """Few different scores: many are equal, and many lie at an end of the search."""
    rng = np.random.default_rng(count)
    given_scores = rng.integers(-4, 5, (count, 6, 37)).astype(np.float32) / 4
    kept = given_scores.copy()
    found = winner(given_scores)
    np.testing.assert_array_equal(given_scores, kept)
    for row in range(6):
        for col in range(37):
            column = kept[:, row, col].tolist()
            place = column.index(max(column))
            far = [score for k, score in enumerate(column) if abs(k - place) > 2]
            expected = (
                place,
                column[place],
                column[max(place - 1, 0)],
                column[min(place + 1, count - 1)],
                max([-1.0, *far]),
            )
            assert tuple(getattr(found, name)[row, col] for name in FIELDS) == expected


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


@pytest.mark.parametrize(
    "matcher", [ReferenceMatcher(), NormalisedCorrelation(max_difference_px=1)]
)
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
