"""The fill law: lines between as few knots as the data need, and holes that count as one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.sensors.fit.test_fit import POSES, wall

from qs3.calibration.fit.fill import _Lines, find_fill
from qs3.calibration.fit.planes import find_wall
from qs3.sensors.devices.fitted import FittedDepth

SMALL = FittedDepth(width_px=320, height_px=240, focal_px=290.0)


def seen(sensor, poses=POSES, first_seed=0):
    return [
        find_wall("wall", wall(sensor, depth, tilt, first_seed + i), sensor.intrinsics)
        for i, (depth, tilt) in enumerate(poses)
    ]


def share(walls):
    """Of all pixels of the walls that have a depth."""
    return np.mean(np.concatenate([np.isfinite(one.depth_m[one.region]) for one in walls]))


@given(st.integers(0, 10_000), st.integers(3, 8))
def test_lines_are_the_least_squares_of_all_pixels(seed, count):
    """Against one design matrix with a row a pixel, for any of the knots and any weights."""
    rng = np.random.default_rng(seed)
    knots = np.sort(rng.uniform(0, 80, count)) + np.arange(count)
    tilt = rng.uniform(knots[0], knots[-1], 400)
    valid = (rng.random(400) < 0.7).astype(float)
    lines, weight = _Lines(knots, tilt, valid), rng.uniform(0.5, 9, 400)
    lines._sum(weight)
    kept = np.union1d([0, count - 1], rng.choice(count, count // 2))
    found, misfit = lines._solved(lines._between(kept))
    design = np.stack([np.interp(tilt, knots[kept], row) for row in np.eye(len(kept))], axis=1)
    root = np.sqrt(weight)
    brute = np.linalg.lstsq(design * root[:, None], valid * root, rcond=None)[0]
    np.testing.assert_allclose(design @ found, design @ brute, atol=1e-6)
    assert misfit == pytest.approx(float((weight * (valid - design @ brute) ** 2).sum()))


@pytest.mark.parametrize(("bend", "knots"), [(32.5, 5), (41.0, 4)])
def test_a_bend_between_knots_is_met_and_chance_makes_none(bend, knots):
    hidden = FittedDepth(tilts_deg=(0, bend, 80), fill_rates=(0.95, 0.95, 0.5), hole_px=1.0)
    found = find_fill(seen(hidden))
    for tilt in (5, 20, bend, 60):
        rates = [
            np.interp(tilt, law.tilts_deg, rate)
            for law, rate in ((hidden, hidden.fill_rates), (found, found.rates))
        ]
        assert rates[1] == pytest.approx(rates[0], abs=0.012)
    assert 3 <= len(found.tilts_deg) <= knots
    assert len(found.seen_deg) > 10


@pytest.mark.parametrize(("rate", "hole_px"), [(0.8, 0.0), (0.8, 1.5), (0.9, 4.0), (0.97, 4.0)])
def test_holes_of_one_rate_need_one_number(rate, hole_px):
    """Large holes are few: what they do to one angle is chance, as what single pixels do is not."""
    hidden = replace(SMALL, fill_rates=(rate,), hole_px=hole_px)
    for seed in range(0, 30, 10):
        walls = seen(hidden, first_seed=seed)
        found = find_fill(walls)
        assert len(found.rates) == 1
        # Weights of rates that chance made would lose a tenth of the holes.
        assert found.rates[0] == pytest.approx(share(walls), abs=0.001)


def test_angles_of_which_there_are_few_pixels_make_no_holes_large():
    """Beyond the last knot its rate is not the camera's, and all those pixels err alike."""
    law = {"tilts_deg": (0, 25, 55, 58, 80), "fill_rates": (0.97, 0.97, 0.93, 0.4, 0.1)}
    hidden = replace(SMALL, width_px=160, height_px=120, focal_px=110.0, **law)
    found = find_fill(seen(hidden, [(1, 5), (1.5, -8), (2, 20), (2, 30)]))
    for tilt in (10, 25, 40, 50):
        wanted = np.interp(tilt, hidden.tilts_deg, hidden.fill_rates)
        assert np.interp(tilt, found.tilts_deg, found.rates) == pytest.approx(wanted, abs=0.02)
    assert len(found.rates) > 1


def test_no_knot_lies_where_nothing_was_seen():
    """Two ranges of angles with nothing between: the first ends at 7.8 degrees, not at 10."""
    law = {"tilts_deg": (0, 4, 8), "fill_rates": (0.95, 0.95, 0.5)}
    hidden = FittedDepth(width_px=200, height_px=150, focal_px=1500.0, **law)
    walls = seen(hidden, [(1, 3.5), (2, 48)])
    found = find_fill(walls)
    angles = np.concatenate([one.tilt_deg[one.region] for one in walls])
    for knot in found.tilts_deg:
        assert np.abs(angles - knot).min() < 0.1
    assert min(found.rates) > 0.4


def test_a_wall_without_holes_is_full():
    found = find_fill(seen(FittedDepth(), POSES[:2]))
    assert found.rates == (1.0,)
    assert found.hole_px == 0


def test_too_few_pixels_give_the_mean_of_all():
    small = FittedDepth(width_px=60, height_px=50, focal_px=25.0, fill_rates=(0.9,))
    found = find_fill(seen(small, [(1.0, 0)]))
    assert found.rates == pytest.approx((0.9,), abs=0.03)
    assert found.seen_deg == ()
