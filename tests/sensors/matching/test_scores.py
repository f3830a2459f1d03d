"""The winner among scores and the correlation, by compiled loops and by numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.sensors.matching import ReferenceMatcher
from qs3.sensors.matching.numba_kernels import best_and_second, to_correlation


def by_numpy(scores):
    last = len(scores) - 1
    place = scores.argmax(axis=0)
    around = [place, np.maximum(place - 1, 0), np.minimum(place + 1, last)]
    found = [np.take_along_axis(scores, index[None], axis=0)[0] for index in around]
    # The runner-up: blank the winner's neighbourhood and look again.
    others = scores.copy()
    for near in range(-2, 3):
        np.put_along_axis(others, np.clip(place + near, 0, last)[None], -1, axis=0)
    return place, np.stack([*found, others.max(axis=0)])


@given(st.integers(3, 70), st.integers(1, 5), st.integers(1, 70), st.integers(0, 2**32 - 1))
def test_both_ways_find_the_same_winner(count, height, width, seed):
    rng = np.random.default_rng(seed)
    some = rng.standard_normal((count, height, width)).astype(np.float32)
    some[rng.random(some.shape) < 0.3] = -1  # outside the other image
    place, around = np.empty((height, width), np.int32), np.empty((4, height, width), np.float32)
    best_and_second(some, place, around)
    for compiled, plain in zip((place, around), by_numpy(some), strict=True):
        np.testing.assert_array_equal(compiled, plain)


def test_the_correlation_is_numpys_to_the_bit():
    """Of parts of larger arrays, as the matcher hands them over."""
    rng = np.random.default_rng(0)
    product, mean_a, mean_b, spread_a, spread_b = rng.random((5, 40, 90)).astype(np.float32) + 0.01
    here, there = np.s_[:, 3:71], np.s_[:, 10:78]
    out = np.zeros((40, 90), np.float32)
    of = (mean_a[here], mean_b[there], spread_a[here], spread_b[there])
    to_correlation(product[here], *of, out[here])
    covariance = product[here] - mean_a[here] * mean_b[there]
    np.testing.assert_array_equal(out[here], covariance / (spread_a[here] * spread_b[there]))
    assert not out[:, :3].any()
    assert not out[:, 71:].any()


def test_scores_equal_a_brute_force_correlation():
    rng = np.random.default_rng(5)
    reference = (rng.random((30, 60)) * 255).astype(np.float32)
    image = (rng.random((30, 40)) * 255).astype(np.uint8)
    matcher = ReferenceMatcher(window_px=5, min_disparity=-4, num_disparities=9)
    scores = matcher._scores(image, reference, first=10)
    grey = image.astype(float)
    for k, row, col in [(0, 15, 20), (4, 10, 9), (8, 20, 31)]:
        window = grey[row - 2 : row + 3, col - 2 : col + 3]
        u = 10 + col - (-4 + k)
        other = reference[row - 2 : row + 3, u - 2 : u + 3].astype(float)
        covariance = (window * other).mean() - window.mean() * other.mean()
        expected = covariance / (window.std() * other.std())
        assert scores[k, row, col] == pytest.approx(expected, abs=1e-3)
