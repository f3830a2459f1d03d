"""The distance of a wall with its standard error, and the bias that follows from some."""

import itertools
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from tests.sensors.fit.test_fit import wall

from qs3.calibration.fit.bias import find_bias
from qs3.calibration.fit.planes import _centre, _Fit, find_wall
from qs3.sensors.devices.fitted import FittedDepth, _smooth

WIDE = FittedDepth(width_px=320, height_px=240, focal_px=250.0, noise_factor=0.004)


def seen(sensor, depth_m, tilt, seed, bend=0.0):
    return find_wall("wall", wall(sensor, depth_m, tilt, seed) + bend, sensor.intrinsics)


def drawn(sensor, tilt, columns, size_px, draws=200):
    """Errors of a wall's distance with noise of 1 / Z, in m, and what is said of them.

    The noise and its plane alone: finding the wall takes a hundred times as long.
    """
    camera, rng = sensor.intrinsics, np.random.default_rng(0)
    shape = (camera.height_px, camera.width_px)
    v, u = np.mgrid[: shape[0], : shape[1]]
    x, y = (u - camera.cx_px) / camera.focal_px, (v - camera.cy_px) / camera.focal_px
    design = np.stack([np.ones(shape), x, y], axis=2)
    true = np.array([1, np.tan(np.deg2rad(tilt)), 0]) / 2.5
    mean = 2.5 * (1 + (2.5 * sensor.noise_factor) ** 2)  # of Z, where that of 1 / Z is 1 / 2.5
    off, said = [], []
    for _ in range(draws):
        inverse = design @ true + sensor.noise_factor * _smooth(shape, size_px, rng)
        on, values = design[:, columns].reshape(-1, 3), inverse[:, columns].ravel()
        normal = np.linalg.lstsq(on, values, rcond=None)[0]
        error = np.full(shape, np.nan)
        error[:, columns] = (values - on @ normal).reshape(shape[0], -1)
        found, sigma = _centre(_Fit(normal, np.ones(0, bool), 0.0, 0.0), on, error, camera)
        off.append(found - mean)
        said.append(sigma)
    return np.array(off), np.array(said)


ALL, LEFT, RIGHT = slice(None), slice(0, 110), slice(200, None)
QUICK = ((0.0, 5, LEFT), (1.5, 5, ALL), (3.0, 50, RIGHT), (3.0, 5, ALL))


@pytest.mark.parametrize(
    ("size_px", "tilt", "columns"),
    [
        pytest.param(*case, marks=() if case in QUICK else pytest.mark.slow)
        for case in itertools.product((0.0, 1.5, 3.0), (5, 50), (ALL, LEFT, RIGHT))
    ],
)
def test_the_standard_error_of_a_distance_is_what_draws_of_the_noise_show(size_px, tilt, columns):
    """Of a wall in all of the view, and of one that the principal point is not on, too."""
    off, said = drawn(replace(WIDE, width_px=240, height_px=180), tilt, columns, size_px)
    # A patch of 24 px holds no more than three quarters of the correlation of 3 px.
    assert np.sqrt(np.mean(off**2)) == pytest.approx(np.sqrt(np.mean(said**2)), rel=0.3)


def test_smooth_noise_leaves_a_distance_as_open_as_few_pixels():
    """A Gaussian of s px makes 4 pi s^2 pixels one."""
    white, smooth = (np.median(drawn(WIDE, 5, slice(None), s, 20)[1]) for s in (0.0, 3.0))
    assert smooth / white == pytest.approx(np.sqrt(4 * np.pi * 9), rel=0.25)


def test_a_bend_beyond_the_noise_moves_the_middle():
    """4 mm by which the middle of the image is further away than a plane through all of it."""
    u = np.linspace(-1, 1, WIDE.width_px, dtype=np.float32)
    bend = 0.012 * (1 / 3 - u**2) * np.ones((WIDE.height_px, 1), np.float32)
    found = seen(replace(WIDE, noise_factor=0.001), 2.0, 5, seed=0, bend=bend)
    assert found.centre_m == pytest.approx(2.004, abs=0.0005)
    assert found.centre_error_m < 0.0005


@pytest.mark.parametrize(
    "bias_m",
    [
        (0.02, 0.0, -0.02),
        *(pytest.param(bias_m, marks=pytest.mark.slow) for bias_m in ((0.0,), (0.0, 0.01))),
    ],
)
def test_the_bias_of_a_noisy_camera_is_found_as_far_as_its_noise_allows(bias_m):
    sensor = replace(WIDE, correlation_px=3.0, bias_m=bias_m)
    distances, value = (0.8, 1.2, 1.7, 2.3, 3.0), np.polynomial.polynomial.polyval
    off, errors = [], []
    for seed in range(0, 20, 5):
        walls = [seen(sensor, depth, 6, seed + i) for i, depth in enumerate(distances)]
        found = find_bias(walls, distances)
        off.append([value(z, found) - value(z, bias_m) for z in distances])
        errors.append([one.centre_error_m for one in walls])
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    # No worse than each wall alone would be, and a floor of a tape's errors of half a millimetre.
    assert (rms < 1.5 * np.hypot(np.mean(errors, axis=0), 5e-4)).all()


@dataclass
class Seen:
    """What `find_bias` takes from a wall."""

    centre_m: float
    centre_error_m: float = 0.0
    tilt_deg: np.ndarray = field(default_factory=lambda: np.full((2, 2), 5.0))
    region: np.ndarray = field(default_factory=lambda: np.ones((2, 2), bool))


def test_a_wall_counts_as_little_as_it_is_known():
    distances = (1.0, 1.5, 2.0, 3.0)
    noisy = [Seen(1.01), Seen(1.51), Seen(2.01), Seen(3.08, centre_error_m=0.05)]
    assert find_bias(noisy, distances) == pytest.approx((0.01,), abs=0.0005)
    slanted = [Seen(1.01), Seen(1.51), Seen(2.01), Seen(3.05, tilt_deg=np.full((2, 2), 85.0))]
    assert find_bias(slanted, distances) == pytest.approx((0.01,), abs=0.0005)


@pytest.mark.parametrize("spread_m", [0.0, 0.005])
@pytest.mark.parametrize("count", [3, 5, 6])
def test_chance_is_seldom_taken_for_a_line(count, spread_m):
    """Whether errors are those of noise and tape, or of millimetres that nothing else tells."""
    rng, distances, rising = np.random.default_rng(0), np.linspace(0.8, 3, count), 0
    for _ in range(300):
        given = 5e-4 * distances / np.cos(np.deg2rad(5)) ** 2
        off = rng.normal(0, np.hypot(given, spread_m))
        rising += len(find_bias([Seen(z) for z in distances + off], distances)) > 1
    # By the noise alone 35 to 41 % of the second kind are.
    assert rising / 300 < 0.2


def test_a_line_of_one_per_cent_is_found_under_millimetres_of_scatter():
    rng, distances, found = np.random.default_rng(0), np.linspace(0.8, 3, 6), 0
    for _ in range(50):
        off = 0.02 * distances + rng.normal(0, 0.003, 6)
        found += len(find_bias([Seen(z) for z in distances + off], distances)) > 1
    assert found > 45


@pytest.mark.parametrize("apart", [0.0, 1e-9, 1e-4])
def test_distances_that_hardly_differ_give_a_constant(apart):
    distances = 2 + apart * np.arange(4)
    assert find_bias([Seen(z + 0.01) for z in distances], distances) == pytest.approx((0.01,))


def test_no_distances_no_bias():
    assert find_bias([Seen(1.0)], None) is None
