"""The distance of a wall with its standard error, and the bias that follows from some."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.sensors.devices.fitted import FittedDepth, _smooth
from qs3.sensors.fit.bias import find_bias
from qs3.sensors.fit.planes import _centre, find_wall
from tests.sensors.fit.test_fit import wall

WIDE = FittedDepth(width_px=320, height_px=240, focal_px=250.0, noise_factor=0.004)


def seen(sensor, depth_m, tilt, seed, bend=0.0):
    return find_wall("wall", wall(sensor, depth_m, tilt, seed) + bend, sensor.intrinsics)


@pytest.mark.parametrize("size_px", [0.0, 1.5, 3.0])
def test_the_standard_error_of_a_distance_is_what_draws_of_the_noise_show(size_px):
    """Noise alone, less its plane; a Gaussian of s px makes 4 pi s^2 pixels one."""
    camera, rng = WIDE.intrinsics, np.random.default_rng(0)
    shape = (camera.height_px, camera.width_px)
    x = (np.arange(camera.width_px) - camera.cx_px) + 0 * np.arange(camera.height_px)[:, None]
    y = (np.arange(camera.height_px) - camera.cy_px)[:, None] + 0 * x
    design = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    off, said = [], []
    for _ in range(300):
        noise = _smooth(shape, size_px, rng).ravel()
        plane = design.T @ noise / (design**2).sum(axis=0)  # orthogonal about the middle
        more, error = _centre((noise - design @ plane).reshape(shape), camera)
        off.append(plane[0] + more)
        said.append(error)
    together = max(1.0, 4 * np.pi * size_px**2)
    # Of 3 px a patch of 24 holds no more than three quarters of the correlation.
    assert np.median(said) == pytest.approx(np.sqrt(together / x.size), rel=0.25)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(
        np.sqrt(np.mean(np.square(said))), rel=0.2
    )


def test_a_bend_beyond_the_noise_moves_the_middle():
    """4 mm by which the middle of the image is further away than a plane through all of it."""
    u = np.linspace(-1, 1, WIDE.width_px, dtype=np.float32)
    bend = 0.012 * (1 / 3 - u**2) * np.ones((WIDE.height_px, 1), np.float32)
    found = seen(replace(WIDE, noise_factor=0.001), 2.0, 5, seed=0, bend=bend)
    assert found.centre_m == pytest.approx(2.004, abs=0.0005)
    assert found.centre_error_m < 0.0005


@pytest.mark.parametrize("bias_m", [(0.0,), (0.0, 0.01), (0.02, 0.0, -0.02)])
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


def test_no_distances_no_bias():
    assert find_bias([seen(WIDE, 1.0, 5, 0)], None) == (0.0,)
