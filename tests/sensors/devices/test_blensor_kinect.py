"""The Kinect in the manner of BlenSor: known values, its window and its fill by brute force."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.geometry.cameras import Window
from qs3.sensors.devices.blensor_kinect import DotMask, spread
from qs3.sensors.optics.misalignment import smooth_field
from tests.sensors.scenery import middle, rectangle, scan, square

KINECT = DotMask()
EXACT = DotMask(field_sigma_px=0.0)


@pytest.mark.parametrize("depth", [0.9, 1.7, 3.3])
def test_a_plane_has_the_depth_of_its_rounded_disparity(renderer, depth):
    frame = scan(EXACT, [square(depth, 0.2 * depth)], renderer)
    fb = EXACT.focal_px * EXACT.baseline_m
    expected = fb / (np.rint(fb / depth * 8) / 8)
    measured = middle(frame.depth_m)
    valid = np.isfinite(measured)
    assert valid.mean() > 0.95
    np.testing.assert_allclose(measured[valid], expected, rtol=1e-5)


def test_only_dots_have_values_and_their_neighbours_up_to_the_radius(renderer):
    bodies = [square(1.5, 0.15)]
    alone = scan(replace(EXACT, fill_px=0.0), bodies, renderer)
    filled = scan(EXACT, bodies, renderer)
    dots = alone.images["left"] == 255
    valid = np.isfinite(alone.depth_m)
    assert not (valid & ~dots).any()
    inner = middle(dots, 0.8)
    assert inner.mean() == pytest.approx(KINECT.pattern.fill, abs=0.01)
    assert middle(valid, 0.8).sum() == inner.sum()
    # A fill needs a wider window: 3 px on each side.
    assert (alone.left - filled.left, alone.top - filled.top) == (3, 3)
    slowly = spread_slowly(alone.depth_m, 3.1)
    np.testing.assert_array_equal(filled.depth_m[3:-3, 3:-3], slowly)
    assert 0.95 < np.isfinite(middle(slowly)).mean() < 1  # a few pixels are far from any dot


def spread_slowly(values, radius):
    """The twin of `spread`, pixel by pixel."""
    out = np.full_like(values, np.nan)
    rows, cols = np.nonzero(np.isfinite(values))
    for r, c in np.ndindex(values.shape):
        if not len(rows):
            break
        squares = (rows - r) ** 2 + (cols - c) ** 2
        nearest = squares.argmin()  # the first in reading order
        if squares[nearest] <= radius**2:
            out[r, c] = values[rows[nearest], cols[nearest]]
    return out


@settings(deadline=None, max_examples=40)
@given(
    st.integers(0, 2**31), st.integers(1, 14), st.integers(1, 14), st.sampled_from([0, 1, 2.5, 3.1])
)
def test_filling_is_that_of_the_nearest_dot(seed, height, width, radius):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(height, width)).astype(np.float32)
    values[rng.uniform(size=values.shape) > 0.15] = np.nan
    np.testing.assert_array_equal(spread(values, radius), spread_slowly(values, radius))


def test_the_window_counts_as_a_loop_over_its_dots_does(renderer):
    """Two thirds of the dots where the centre's depth would put them, within 5 cm."""
    camera = replace(EXACT, fill_px=0.0, min_share=2 / 3)
    bodies = [rectangle(1.2, -0.1, 0.02, -0.05, 0.08), rectangle(1.5, -0.15, 0.15, -0.1, 0.1)]
    frame = scan(camera, bodies, renderer, explain=True)
    clean, lit = frame.clean_m, frame.images["lit"]
    slide = camera.pattern.slide
    fb = camera.focal_px * camera.baseline_m
    expected = np.zeros(clean.shape, dtype=bool)
    for r, c in np.ndindex(clean.shape):
        if not lit[r, c] or not np.isfinite(clean[r, c]):
            continue
        row = frame.top + r
        col = int(np.rint(frame.left + c - fb / np.float64(clean[r, c])))
        if not slide[row % 495, col % 633]:
            continue
        dots = seen = 0
        for dr in range(-4, 5):
            for dc in range(-4, 5):
                if not slide[(row + dr) % 495, (col + dc) % 633]:
                    continue
                dots += 1
                y, x = r + dr, c + dc
                if 0 <= y < clean.shape[0] and 0 <= x < clean.shape[1] and lit[y, x]:
                    seen += bool(abs(clean[y, x] - clean[r, c]) < np.float32(0.05))
        expected[r, c] = 3 * seen > 2 * dots
    assert expected.any()
    np.testing.assert_array_equal(np.isfinite(frame.depth_m), expected)


def test_the_field_is_smooth_of_unit_size_and_knows_no_window():
    whole, part = Window(0, 0, 200, 160), Window(60, 50, 90, 70)
    fields = np.stack([smooth_field(whole, 32.0, np.random.default_rng(s)) for s in range(60)])
    assert fields.std() == pytest.approx(1, rel=0.05)
    assert abs(fields.mean()) < 0.05
    inside = smooth_field(part, 32.0, np.random.default_rng(7))
    np.testing.assert_allclose(inside, fields[7][50:120, 60:150], atol=1e-9)
    # No wave is shorter than 32 px: the slope's variance is (2 pi / 32)^2 / 4 along each axis.
    slope = np.gradient(fields, axis=2)[:, :, 1:-1]
    assert slope.std() == pytest.approx(np.pi / 32, rel=0.1)
