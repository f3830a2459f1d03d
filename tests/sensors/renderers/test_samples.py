"""Samples a pixel change the cost, not the noise of the depth: that is the sensor model's."""

import numpy as np
import pytest

from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.scenery import scan, square

PHASES = 6  # planes at evenly spaced sub-pixel disparities, or pixel locking decides


def subpixel_rms_px(depth_m, samples, sensor):
    """RMS of f b / Z - f b / Z_plane over planes near `depth_m`, without the outer 0.5 %.

    The definition of librealsense's depth quality tool; the plane is the true one.
    """
    renderer = MitsubaRenderer(samples=samples)
    px_m, errors = sensor.focal_px * sensor.baseline_m, []
    for phase in range(PHASES):
        z = 1 / (1 / depth_m + phase / PHASES / px_m)
        frame = scan(sensor, [square(z, 0.25)], renderer, seed=phase)
        inner = frame.depth_m[10:-10, 10:-10]
        error = px_m / inner[np.isfinite(inner)] - px_m / z
        low, high = np.percentile(error, [0.5, 99.5])
        errors.append(error[(error >= low) & (error <= high)])
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


@pytest.mark.parametrize(
    "depth_m", [4.0, *(pytest.param(z, marks=pytest.mark.slow) for z in (3.0, 5.0))]
)
def test_4_samples_are_as_noisy_as_16_and_read_noise_shows(depth_m):
    few, many = (subpixel_rms_px(depth_m, samples, SpeckleStereo()) for samples in (4, 16))
    assert few / many == pytest.approx(1, abs=0.1)
    loud = SpeckleStereo(infrared=InfraredCamera(read_noise_e=500.0))
    assert subpixel_rms_px(depth_m, 4, loud) > 1.15 * few
