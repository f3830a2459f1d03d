"""Census strings, semi-global paths and sub-pixels: known answers and brute-force twins."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.sensors.matching import CensusMatcher
from qs3.sensors.matching.base import offset
from qs3.sensors.matching.census import census
from qs3.sensors.matching.numba_kernels import cheapest, path_sums
from qs3.sensors.optics.visibility import Reason
from tests.sensors.matching.textures import dots, seen


def brighter(image, window, row, col):
    """The census string by its definition."""
    half = window // 2
    padded = np.pad(image, half, mode="reflect")
    part = padded[row : row + window, col : col + window].ravel()
    return np.delete(part > image[row, col], window**2 // 2)


@pytest.mark.parametrize("window", [3, 5, 9, 13])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_hamming_distances_equal_a_count_by_hand(window, dtype):
    rng = np.random.default_rng(window)
    a, b = (rng.integers(0, 9, (14, 15)).astype(dtype) for _ in range(2))
    words = zip(census(a, window), census(b, window), strict=True)
    ones = np.vectorize(lambda word: int(word).bit_count())
    distance = sum(ones(x ^ y) for x, y in words)
    for row, col in itertools.product(range(14), range(15)):
        by_hand = (brighter(a, window, row, col) != brighter(b, window, row, col)).sum()
        assert distance[row, col] == by_hand


@pytest.mark.parametrize(("low", "first"), [(0, 0), (-3, 6), (-2, -4), (1, 12)])
def test_costs_equal_sums_by_hand(low, first):
    rng = np.random.default_rng(1)
    image = rng.integers(0, 60, (8, 12)).astype(np.uint8)
    other = (rng.random((8, 20)) * 60).astype(np.float32)
    count = 5
    matcher = CensusMatcher(count, low, 5, 3)
    cost = matcher._cost(image, other, first - (low + count - 1))
    worst = 24
    single = np.zeros((8, 12, count), int)
    for row, col, j in itertools.product(range(8), range(12), range(count)):
        column = first + col - (low + count - 1 - j)
        if not 0 <= column < 20:
            single[row, col, j] = worst
            continue
        bits = brighter(image, 5, row, col) != brighter(other, 5, row, column)
        single[row, col, j] = bits.sum()
    padded = np.pad(single, ((1, 1), (1, 1), (0, 0)), mode="reflect")
    block = sum(padded[y : y + 8, x : x + 12] for y in range(3) for x in range(3))
    np.testing.assert_array_equal(cost, block)


def path_costs(cost, small, large, step):
    """One path by recursion over pixels."""
    height, width, count = cost.shape
    done = {}

    def at(row, col):
        if (row, col) not in done:
            r, c = row - step[0], col - step[1]
            here = cost[row, col].astype(int)
            if 0 <= r < height and 0 <= c < width:
                before = at(r, c)
                for d in range(count):
                    near = [before[k] + small for k in (d - 1, d + 1) if 0 <= k < count]
                    here[d] += min(before[d], *near, min(before) + large) - min(before)
            done[row, col] = here
        return done[row, col]

    return np.array([[at(row, col) for col in range(width)] for row in range(height)])


def test_path_sums_equal_a_recursion_by_hand():
    cost = np.random.default_rng(4).integers(0, 90, (6, 7, 4)).astype(np.uint16)
    steps = [(0, 1), (0, -1), (1, 0), (-1, 0)]
    for drop in (0, 2):
        by_hand = sum(path_costs(cost >> drop, 5, 31, step) for step in steps)
        found = np.empty_like(cost)
        path_sums(cost, *np.array([drop, 5, 31], np.uint16), found)
        np.testing.assert_array_equal(found, by_hand)


def test_the_best_places_of_both_images_and_what_decides_whether_they_count():
    rng = np.random.default_rng(2)
    total, cost = rng.integers(0, 30, (2, 3, 7, 4)).astype(np.uint16)
    best, beside = np.empty((3, 7), np.int32), np.empty((5, 3, 7), np.float32)
    back = np.empty((3, 10), np.int32)
    cheapest(total, cost, best, beside, back)
    np.testing.assert_array_equal(best, total.argmin(axis=2))
    for row, u in itertools.product(range(3), range(7)):
        here = best[row, u]
        near = [cost[row, u, min(max(here + step, 0), 3)] for step in (-1, 0, 1)]
        others = [total[row, u, j] for j in range(4) if abs(j - here) > 1] or [65535]
        assert beside[:, row, u].tolist() == [*near, total[row, u, here], min(others)]
    for row, x in itertools.product(range(3), range(7 + 3)):
        costs = {j: total[row, x - j, j] for j in range(4) if 0 <= x - j < 7}
        assert back[row, x] == min(costs, key=costs.get)


@given(st.floats(-0.5, 0.5), st.floats(1, 90))
def test_a_fit_returns_the_minimum_of_its_own_curve(true, scale):
    costs = np.abs(np.array([-1, 0, 1]) - true) * scale + 7
    assert offset(*costs.astype(np.float32).reshape(3, 1))[0] == pytest.approx(true, abs=1e-3)


def test_gain_and_offset_change_no_bit():
    texture = dots(60, 200, 5)
    image, other = (seen(texture, d, s) // 3 for d, s in ((14.5, 1), (0, 2)))
    matcher = CensusMatcher(32, min_texture=0.0)  # which is measured in grey values
    plain, loud = matcher.match(image, other), matcher.match(2 * image + 3, other + 60)
    assert np.isfinite(plain.disparity[:, 50:]).mean() > 0.9
    np.testing.assert_array_equal(plain.disparity, loud.disparity)


def test_reasons_say_why_there_is_no_match():
    texture = dots(60, 200, 8)
    image, other = seen(texture, 20, 1), seen(texture, 0, 2)
    matcher = CensusMatcher(32)
    # Columns 0..39 of the image come from before the other one begins.
    found = matcher.match(image[:, 20:], other[:, 40:], first=-20)
    assert (found.reason[8:-8, :30] != Reason.OK).mean() > 0.95
    assert (found.reason[8:-8, 56:-12] == Reason.OK).mean() > 0.98
    nowhere = matcher.match(image[:, :50], other, first=-60).reason
    assert (nowhere == Reason.OUTSIDE).all()
    dark = np.full_like(image, 7)
    assert (matcher.match(dark, other, 0).reason[:, 40:] == Reason.DARK).mean() > 0.99
    # A pattern that repeats every 10 px fits at 5, 15 and 25 px. Paths would decide from what
    # they met at the border.
    tile = np.tile(seen(texture, 0, 3)[:, :10], (1, 20))
    repeated = CensusMatcher(32, paths=0).match(tile, tile, first=5).reason[8:-8, 50:-20]
    assert (repeated == Reason.AMBIGUOUS).mean() > 0.95
    # Hidden from the other camera: those pixels find somebody else's partner.
    hidden = image.copy()
    hidden[:, 100:115] = seen(dots(60, 200, 9), 0, 4)[:, 100:115]
    why = CensusMatcher(32, uniqueness_percent=0.0, block_px=3, paths=0).match(hidden, other).reason
    assert (why[:, 103:112] == Reason.INCONSISTENT).mean() > 0.5
