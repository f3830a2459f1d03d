import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.geometry.cameras import look_at
from qs3.sensors.devices.fitted import FittedDepth

POSE = look_at(np.zeros(3), np.array([1.0, 0.0, 0.0]))
FLAT = np.full((300, 400), 2.0, np.float32)


@settings(max_examples=15, deadline=None)
@given(st.floats(0.5, 4.0), st.floats(0, 0.004), st.floats(0.0005, 0.01), st.sampled_from([1, 2]))
def test_noise_and_bias_follow_their_laws(depth, floor, factor, power):
    sensor = FittedDepth(
        noise_floor_m=floor, noise_factor=factor, noise_power=power, bias_m=(0.01, -0.002)
    )
    found, _ = sensor.measure(FLAT / 2 * np.float32(depth), np.random.default_rng(0))
    law = floor + factor * depth**power
    assert sensor.noise_law_m(depth) == pytest.approx(law)
    assert found.std() == pytest.approx(law, rel=0.02)
    assert found.mean() - depth == pytest.approx(0.01 - 0.002 * depth, abs=0.02 * law + 1e-5)


def test_steps_are_of_one_size_in_what_they_are_said_to_be():
    slope = np.linspace(1, 3, 120_000, dtype=np.float32).reshape(300, 400)
    rng = np.random.default_rng(0)
    inverse, _ = FittedDepth(inverse_step_per_m=0.003).measure(slope, rng)
    steps = 1 / inverse / np.float32(0.003)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)
    whole, _ = FittedDepth(depth_step_m=0.01).measure(slope, rng)
    np.testing.assert_allclose(whole * 100, np.rint(whole * 100), atol=1e-3)


@pytest.mark.parametrize("size", [0.0, 0.8, 2.5])
def test_neighbours_share_noise_as_stated(size):
    sensor = FittedDepth(correlation_px=size)
    error = sensor.measure(FLAT, np.random.default_rng(1))[0] - 2
    across = np.corrcoef(error[:, 1:].ravel(), error[:, :-1].ravel())[0, 1]
    down = np.corrcoef(error[1:].ravel(), error[:-1].ravel())[0, 1]
    expected = np.exp(-1 / (4 * size**2)) if size else 0.0
    assert across == pytest.approx(expected, abs=0.02)
    assert down == pytest.approx(expected, abs=0.02)


def test_so_many_pixels_are_filled():
    found, _ = FittedDepth(fill_rate=0.65).measure(FLAT, np.random.default_rng(0))
    assert np.isfinite(found).mean() == pytest.approx(0.65, abs=0.005)
