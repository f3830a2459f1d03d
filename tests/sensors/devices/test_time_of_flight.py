"""Time of flight obeys its own law, folds where it must, and mixes what a pixel sees."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.sensors.base import on_grid
from qs3.sensors.devices.gaussian_time_of_flight import GaussianTimeOfFlight
from qs3.sensors.devices.time_of_flight import SPEED_OF_LIGHT, TimeOfFlight, unwrapped
from qs3.sensors.optics.visibility import Reason
from tests.sensors.scenery import box_of, middle, rectangle, scan, square

CAMERA = TimeOfFlight()
# Next to no noise, and a lamp in the lens, so without shadows.
QUIET = TimeOfFlight(
    lamp_offset_m=0.0, electrons_at_1m=1e12, full_well_e=1e15, read_noise_e=0.0, ambient=0.0
)


def rays(frame):
    """Length of the ray through each sample at depth 1."""
    k = frame.camera.intrinsics
    rows, cols = np.indices(frame.depth_m.shape) * frame.step_px
    x, y = (frame.left + cols - k.cx_px) / k.focal_px, (frame.top + rows - k.cy_px) / k.focal_px
    return np.sqrt(1 + x * x + y * y)


@pytest.mark.parametrize(
    ("albedo", "frequencies"), [(0.2, (16e6,)), (0.8, (80e6, 16e6))], ids=["one", "two"]
)
def test_noise_and_bias_follow_the_stated_law(renderer, albedo, frequencies):
    camera = replace(CAMERA, frequencies_hz=frequencies)
    seen = []
    for depth in (1.0, 2.0, 3.5):
        body = square(depth, half_m=0.3 * depth, albedo=albedo)
        frame = scan(camera, [body], renderer, seed=int(depth))
        error = middle((frame.depth_m - depth) * rays(frame))  # along the ray
        assert np.isfinite(error).all()
        light = albedo / depth**2  # white at 1 m has radiance 1
        mean_e = camera.electrons_at_1m * (light + albedo * camera.ambient)
        amplitude_e = camera.electrons_at_1m * camera.contrast * light
        noise = np.sqrt(mean_e + camera.read_noise_e**2) / (math.sqrt(2) * amplitude_e)
        together = math.hypot(*frequencies)
        sigma = SPEED_OF_LIGHT / (4 * math.pi * together) * noise
        assert error.std() == pytest.approx(sigma, rel=0.05)  # of about 8,000 pixels
        assert abs(error.mean()) < 4 * sigma / np.sqrt(error.size) + 1e-6
        seen.append(error.std())
    # Between the first power of the distance (shot noise) and the second (read-out).
    assert 1.0 < np.log(seen[2] / seen[0]) / np.log(3.5) < 2.0


def test_one_frequency_folds_distances_back(renderer):
    camera = replace(CAMERA, frequencies_hz=(40e6,), electrons_at_1m=1e7, full_well_e=1e9)
    ambiguity_m = SPEED_OF_LIGHT / 80e6
    far = 1.2 + ambiguity_m
    folded = scan(camera, [square(far, 1.0)], renderer)
    length = middle(rays(folded))
    distance = middle(folded.depth_m) * length
    expected = far * length - ambiguity_m
    np.testing.assert_allclose(distance, expected, atol=0.01)
    both = replace(camera, frequencies_hz=(40e6, 16e6))  # their gcd, 8 MHz, reaches 18.7 m
    right = scan(both, [square(far, 1.0)], renderer)
    np.testing.assert_allclose(middle(right.depth_m), far, atol=0.01)


FREQUENCIES = [(16e6,), (80e6, 16e6), (16e6, 80e6, 120e6), (60e6, 80e6), (100e6, 30e6)]


@settings(deadline=None)
@given(
    st.sampled_from(FREQUENCIES),
    st.lists(st.floats(0.01, 0.99), min_size=1, max_size=6),
    st.floats(1.0, 1e4),
)
def test_unwrapping_finds_every_distance_in_range(frequencies, shares, amplitude):
    ambiguity_m = SPEED_OF_LIGHT / (2 * math.gcd(*map(round, frequencies)))
    true = np.array(shares)[None] * ambiguity_m
    f = np.array(frequencies)[:, None, None]
    phase = (4 * np.pi * f * true / SPEED_OF_LIGHT) % (2 * np.pi)
    amplitudes = amplitude * np.linspace(1, 2, len(f))[:, None, None] * np.ones_like(phase)
    found, disagreement = unwrapped(phase, amplitudes, frequencies)
    np.testing.assert_allclose(found, true, atol=1e-6)
    assert disagreement.max() < 1e-6


def edge_scene(camera, near, far, share_of_pixel):
    """A near rectangle that ends inside pixels of one column, before a far one."""
    column = 170
    edge_u = column - 0.5 + share_of_pixel
    edge = near * (edge_u - camera.intrinsics.cx_px) / camera.focal_px
    return column, [rectangle(near, -0.2, edge), rectangle(far, -0.4, 0.4)]


@pytest.mark.parametrize("thirds", [1, 2])
def test_a_pixel_on_an_edge_adds_the_phasors_of_both_surfaces(renderer, thirds):
    camera = replace(QUIET, frequencies_hz=(16e6,))
    near, far, share = 1.2, 2.0, thirds / 3
    column, bodies = edge_scene(camera, near, far, share)
    frame = scan(camera, bodies, renderer, box=box_of(bodies[0]))
    row = np.argmin(np.abs(frame.top + np.arange(len(frame.depth_m)) - camera.intrinsics.cy_px))
    mixed = frame.depth_m[row, column - frame.left]
    # Radiance falls with the square of the depth; near the axis a ray is as long as deep.
    wave = 4j * np.pi * 16e6 / SPEED_OF_LIGHT
    length = rays(frame)[row, column - frame.left]
    phasor = share * np.exp(wave * near * length) / near**2
    phasor += (1 - share) * np.exp(wave * far * length) / far**2
    expected = np.angle(phasor) % (2 * np.pi) / abs(wave) / length
    assert near + 0.05 < expected < far - 0.05
    assert mixed == pytest.approx(expected, abs=0.002)
    assert frame.depth_m[row, column - frame.left - 1] == pytest.approx(near, abs=1e-4)


def test_reasons(renderer):
    def reasons(camera, bodies, **more):
        frame = scan(camera, bodies, renderer, **more)
        np.testing.assert_array_equal(np.isfinite(frame.depth_m), frame.reason == Reason.OK)
        return frame

    ok = reasons(CAMERA, [square(1.0)])
    assert set(np.unique(ok.reason)) <= {Reason.OK, Reason.EMPTY, Reason.DARK}
    assert (ok.reason[~np.isfinite(ok.clean_m)] == Reason.EMPTY).mean() > 0.95
    assert (middle(reasons(CAMERA, [square(4.0, albedo=0.02)]).reason) == Reason.DARK).all()
    near = replace(CAMERA, min_depth_m=0.1)
    assert (middle(reasons(near, [square(0.3, 0.1)]).reason) == Reason.SATURATED).all()
    bright = replace(CAMERA, electrons_at_1m=1e6, full_well_e=1e9)
    assert (middle(reasons(bright, [square(7.0)]).reason) == Reason.RANGE).all()


def test_blensors_noise_is_one_normal_law_along_the_ray(renderer):
    camera = GaussianTimeOfFlight(noise_mean_m=0.01)
    for depth in (1.0, 4.0):
        frame = scan(camera, [square(depth, 0.3 * depth)], renderer, seed=1)
        error = middle((frame.depth_m - depth) * rays(frame))
        assert error.mean() == pytest.approx(0.01, abs=3e-4)
        assert error.std() == pytest.approx(0.004, rel=0.05)


@given(st.integers(0, 50), st.integers(1, 50), st.integers(1, 7))
def test_samples_lie_on_one_grid_whatever_the_window(start, count, step):
    first, part = on_grid(start, count, step)
    expected = [x for x in range(start, start + count) if x % step == step // 2]
    assert list(np.arange(start, start + count)[part]) == expected
    assert not expected or first == expected[0]
