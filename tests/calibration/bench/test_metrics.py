"""The bench's measurements on data whose answer is known."""

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.calibration.bench import infrared_images, laws, metrics, real
from qs3.calibration.bench.tabletop import Tabletop
from qs3.calibration.bench.targets import POSE, TiltedPlane
from qs3.geometry.cameras import Intrinsics


def plane_grid(inverse, half=0.08, count=60):
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-half, half, count)] * 2))
    return x, y, 1 / (inverse[0] * x + inverse[1] * y + inverse[2])


@pytest.mark.parametrize("size", [1, 4, 9])
def test_the_correlation_length_of_a_moving_average_is_half_its_window(size):
    """The correlation of a mean over n falls by 1 / n a pixel."""
    rng = np.random.default_rng(size)
    noise = [cv2.blur(rng.standard_normal((200, 210)), (size, size)) for _ in range(2)]
    maps = [image[20:-20, 20:-20] for image in noise]
    assert metrics.correlation_px(maps) == pytest.approx(size / 2, rel=0.1)
    holes = [np.where(rng.random(image.shape) < 0.2, np.nan, image) for image in maps]
    assert metrics.correlation_px(holes) == pytest.approx(size / 2, rel=0.1)
    assert np.isnan(metrics.correlation_px([np.full((5, 5), np.nan)]))
    assert np.isnan(metrics.correlation_px([np.ones((5, 5))]))


def test_contrast_and_correlation_of_known_pictures():
    stripes = np.tile([10.0, 30.0], (40, 20))
    # Of the 81 pixels 36 or 45 are bright: p (1 - p) is 0.2469.
    means = [10 + 20 * n / 81 for n in (36, 45)]
    low, high = sorted(20 * np.sqrt(36 * 45 / 81**2) / mean for mean in means)
    assert low <= infrared_images.contrast(stripes) <= high
    assert infrared_images.contrast(np.full((20, 20), 7.0)) == 0
    rng = np.random.default_rng(0)
    blurred = cv2.GaussianBlur(rng.standard_normal((300, 300)), (0, 0), 1.5)

    def shared(lag, variance):  # a product of Gaussians of white noise in the plane
        return np.exp(-(lag**2) / (2 * variance)) / variance

    def left(lag):  # of a Gaussian of 1.5 px less the same through another of 10
        wide = 2 * 1.5**2
        return shared(lag, wide) - 2 * shared(lag, wide + 100) + shared(lag, wide + 200)

    for lag in (1, 2, 3):
        expected = left(lag) / left(0)
        assert infrared_images.autocorrelation(blurred, lag) == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("tilt", [0.0, 50.0])
def test_the_fitted_plane_is_the_one_the_points_lie_on(tilt):
    inverse = TiltedPlane(2.0, tilt, across=True).inverse(580.0)
    x, y, z = plane_grid(inverse)
    fit = metrics.fit_plane(z, x, y, 43.5)
    np.testing.assert_allclose(fit.inverse, inverse, rtol=1e-6, atol=1e-9)
    assert fit.rms_m < 1e-9
    assert fit.points == len(z) - 2 * int(0.005 * len(z))


def test_plane_fit_and_subpixel_rms_are_the_noise_that_was_put_in():
    rng = np.random.default_rng(0)
    x, y, z = plane_grid(TiltedPlane(2.0, 40.0).inverse(580.0), count=120)
    noisy = 43.5 / (43.5 / z + rng.normal(0, 0.07, z.shape))
    fit = metrics.fit_plane(noisy, x, y, 43.5)
    assert fit.subpixel_rms_px == pytest.approx(0.07, rel=0.03)
    # Along the axis sigma is Z^2 / (f B) sigma_d; towards a plane tilted by 40 degrees, its cosine.
    along_axis = laws.triangulation_m(2.0, 580.0, 0.075, 0.07)
    assert fit.rms_m == pytest.approx(along_axis * np.cos(np.deg2rad(40)), rel=0.06)


def test_too_few_points_are_no_plane():
    fit = metrics.fit_plane(np.ones(9), np.zeros(9), np.zeros(9), 43.5)
    assert np.isnan(fit.rms_m)


def test_the_exponent_of_a_power_law_comes_back():
    z = np.array([0.8, 1, 2, 3, 5])
    p, a = metrics.power_law(z, 0.0017 * z**1.9)
    assert (p, a) == (pytest.approx(1.9), pytest.approx(0.0017))


@given(st.floats(2, 60), st.floats(0.1, 5), st.sampled_from([8, 16, 32]), st.floats(-0.5, 0.5))
def test_expected_levels_are_counted_like_one_by_one(low, span, steps, offset):
    grid = np.arange(-100, 100 * steps + 100) / steps + offset
    inside = ((grid >= low - 1e-9) & (grid <= low + span + 1e-9)).sum()
    # Within rounding of an end of the range a level may count or not.
    assert abs(metrics.expected_levels(low, low + span, steps, offset) - inside) <= (
        np.min(np.abs(grid - low)) < 1e-6
    ) + (np.min(np.abs(grid - low - span)) < 1e-6)


def test_levels_of_a_quantised_ramp_are_those_expected():
    ramp = np.rint(np.linspace(10.03, 11.49, 5000) * 8) / 8
    inside = ramp[(ramp >= 10.03) & (ramp <= 11.49)]
    assert len(metrics.levels(inside)) == metrics.expected_levels(10.03, 11.49, 8, 0.0) == 11


def test_locking_is_the_amplitude_of_the_wave():
    phase = (np.arange(16) + 0.3) / 16
    error = 0.01 + 0.04 * np.sin(2 * np.pi * phase + 0.7)
    assert metrics.locking_px(phase, error) == pytest.approx(0.04)


@given(st.lists(st.lists(st.booleans(), min_size=7, max_size=7), min_size=1, max_size=5))
def test_runs_are_those_of_a_walk_along_each_row(rows):
    walked = [len(list(group)) for row in rows for key, group in itertools.groupby(row) if key]
    assert metrics.runs(np.array(rows)).tolist() == walked


def test_published_laws_give_their_published_numbers():
    """Millimetres of the two papers' formulas, computed by hand."""
    np.testing.assert_allclose(
        1e3 * laws.nguyen_axial_m(np.array([1.0, 2.0, 4.0])), [1.884, 6.064, 25.824]
    )
    assert 1e3 * laws.nguyen_axial_m(2.0, 80) == pytest.approx(10.6, abs=0.1)
    assert 1e3 * laws.khoshelham_m(5.0) == pytest.approx(35.6, abs=0.1)
    assert laws.nguyen_lateral_px(70) == pytest.approx(0.92, abs=0.005)
    # D435: f = 424 px, B = 50 mm, 0.08 px at 2 m.
    assert 1e3 * laws.triangulation_m(2.0, 424, 0.05, 0.08) == pytest.approx(15.1, abs=0.05)
    assert laws.ramp_angle_deg(19, 0.1, 4.0) == pytest.approx(64.5, abs=0.1)


@given(st.floats(-80, 80), st.booleans(), st.floats(-60, 60), st.floats(-60, 60))
def test_a_tilted_plane_has_its_depth_and_its_angle_at_the_centre(tilt, across, u, v):
    plane = TiltedPlane(1.7, tilt, across, (u, v))
    assert plane.depth_at(np.array(u), np.array(v), 500.0) == pytest.approx(1.7)
    normal = plane.inverse(500.0)
    ray = np.array([u / 500, v / 500, 1])
    cosine = normal @ ray / np.linalg.norm(normal) / np.linalg.norm(ray)
    assert cosine == pytest.approx(np.cos(np.deg2rad(tilt)), abs=1e-9)


def test_the_plane_as_a_mesh_lies_where_the_formula_says():
    k = Intrinsics.centred(640, 480, 580.0)
    plane = TiltedPlane(2.0, 65.0, True, (10.0, -20.0))
    region = plane.region(k, 24)
    (body,), box = plane.scene(k, region, 12)
    local = body.mesh.vertices @ POSE[:3, :3]
    np.testing.assert_allclose(local @ plane.inverse(580.0), 1, atol=1e-9)
    assert (box[0] < box[1]).all()


def depth_steps(fb=43.5):
    """The distinct depths of a sensor with 1/8 px, in whole millimetres."""
    levels = fb / (np.arange(8 * 33, 8 * 55) / 8)
    return np.unique(np.rint(levels * 1000)) / 1000


def test_the_focal_baseline_is_read_off_the_depth_steps():
    fb, residual = real.fit_steps(depth_steps(43.5))
    assert fb == pytest.approx(43.5, abs=0.1)
    assert residual < 0.15
    anywhere = np.unique(np.random.default_rng(0).uniform(0.8, 1.3, 200).round(3))
    assert real.fit_steps(anywhere)[1] > 0.2


def test_a_shadow_lies_on_the_side_it_was_put():
    depth = np.full((40, 80), 1.5, dtype=np.float32)
    depth[10:30, 40:60] = 1.0
    depth[10:30, 32:40] = np.nan  # left of the near square
    depth[10:20, 60:62] = np.nan
    gaps = ~np.isfinite(depth)
    assert real.shadow_side(depth, gaps) == pytest.approx(160 / 180)


def test_the_noise_of_a_table_is_what_was_put_on_it():
    rng = np.random.default_rng(1)
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    x, y = (u - 319.5) / real.FOCAL_PX, (v - 239.5) / real.FOCAL_PX
    z = 0.59 / (0.75 * y + 0.66)
    z = np.where((z > 0.5) & (z < 1.3), z, np.nan) + 0 * x
    noisy = 43.5 / (43.5 / z + rng.normal(0, 0.08, z.shape))
    rms_m, subpixel = real.table_noise(noisy)
    assert subpixel == pytest.approx(0.08, rel=0.05)
    assert 0.0003 < rms_m < 0.003


def test_moving_to_the_colour_camera_keeps_depth_and_opens_a_gap_behind_the_near():
    depth = np.full((480, 640), 1.5, dtype=np.float32)
    depth[200:280, 300:380] = 0.8
    moved = Tabletop().registered(depth, 580.0)
    inside = moved[100:380, 100:540]
    values = inside[np.isfinite(inside)]
    assert set(np.unique(values)) == {np.float32(0.8), np.float32(1.5)}
    gap = 525 * 0.025 * (1 / 0.8 - 1 / 1.5)
    row = np.isnan(moved[240, 150:500])
    # Seen from further right, a strip of the wall right of the square comes into view.
    assert row.sum() == pytest.approx(gap, abs=1.5)


def test_a_trimmed_normal_error_is_smaller_by_the_factor_stated():
    values = np.random.default_rng(0).standard_normal(400_000)
    assert metrics.trimmed(values).std() == pytest.approx(metrics.TRIMMED_NORMAL, rel=0.003)


def test_a_mixed_pixel_is_one_between_two_surfaces():
    depth = np.full((4, 9), 1.0)
    depth[:, 5:] = 2.0
    assert real.depth_steps(depth) == (0, 4)
    depth[1, 5] = 1.5  # along the row between both; in its column 1.5 beside 2.0 twice
    # Rows: 3 sharp steps and the mixed one. Column 5: two steps, on the sides of the pixel.
    assert real.depth_steps(depth) == (1, 6)
    depth[1, 5] = np.nan
    assert real.depth_steps(depth) == (0, 3)
    assert real.depth_steps(np.ones((5, 5))) == (0, 0)
