"""The fill law: lines between as few knots as the data need, and holes that count as one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.sensors.devices.fitted import FittedDepth
from qs3.sensors.fit.fill import _Lines, find_fill
from qs3.sensors.fit.planes import find_wall
from tests.sensors.fit.test_fit import POSES, wall


def seen(sensor, poses=POSES, first_seed=0):
    return [
        find_wall("wall", wall(sensor, depth, tilt, first_seed + i), sensor.intrinsics)
        for i, (depth, tilt) in enumerate(poses)
    ]


@given(st.integers(0, 10_000), st.integers(3, 8))
def test_lines_are_the_least_squares_of_all_pixels(seed, count):
    """Against one design matrix with a row a pixel, for any of the knots."""
    rng = np.random.default_rng(seed)
    knots = np.sort(rng.uniform(0, 80, count)) + np.arange(count)
    tilt = rng.uniform(knots[0], knots[-1], 400)
    valid = (rng.random(400) < 0.7).astype(float)
    lines = _Lines(knots, tilt, valid)
    kept = np.union1d([0, count - 1], rng.choice(count, count // 2))
    found, misfit = lines._solved(lines._between(kept))
    design = np.stack([np.interp(tilt, knots[kept], row) for row in np.eye(len(kept))], axis=1)
    root = np.sqrt(lines.weight)
    brute = np.linalg.lstsq(design * root[:, None], valid * root, rcond=None)[0]
    np.testing.assert_allclose(design @ found, design @ brute, atol=1e-6)
    assert misfit == pytest.approx(float((lines.weight * (valid - design @ brute) ** 2).sum()))


@pytest.mark.parametrize("bend", [32.5, 41.0])
def test_a_bend_between_knots_is_met_and_chance_makes_none(bend):
    hidden = FittedDepth(tilts_deg=(0, bend, 80), fill_rates=(0.95, 0.95, 0.5), hole_px=1.0)
    found = find_fill(seen(hidden))
    for tilt in (5, 20, bend, 60):
        rates = [
            np.interp(tilt, law.tilts_deg, rate)
            for law, rate in ((hidden, hidden.fill_rates), (found, found.rates))
        ]
        assert rates[1] == pytest.approx(rates[0], abs=0.012)
    assert 3 <= len(found.tilts_deg) <= 6
    assert len(found.seen_deg) > 10


@pytest.mark.parametrize("hole_px", [0.0, 1.5, 4.0])
def test_holes_of_one_rate_need_one_number(hole_px):
    """Large holes are few: what they do to one angle is chance, as what single pixels do is not."""
    hidden = FittedDepth(fill_rates=(0.8,), hole_px=hole_px)
    found = find_fill(seen(hidden))
    assert len(found.rates) == 1
    assert found.rates[0] == pytest.approx(0.8, abs=0.02)


def test_a_wall_without_holes_is_full():
    found = find_fill(seen(FittedDepth(), POSES[:2]))
    assert found.rates == (1.0,)
    assert found.hole_px == 0


def test_too_few_pixels_give_the_mean_of_all():
    small = FittedDepth(width_px=60, height_px=50, focal_px=25.0, fill_rates=(0.9,))
    found = find_fill(seen(small, [(1.0, 0)]))
    assert found.rates == pytest.approx((0.9,), abs=0.03)
    assert found.seen_deg == ()
