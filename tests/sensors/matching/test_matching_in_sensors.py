"""Every matcher in every sensor that matches, through the real renderer; and their configs."""

import numpy as np
import pytest

from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.matching import (
    CensusMatcher,
    ReferenceMatcher,
    StereoBlockMatcher,
)
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.scenery import middle, scan, square

STEREO = {
    "block": StereoBlockMatcher(80, 15),
    "correlation": ReferenceMatcher(11, 0, 80, 0),
    "census": CensusMatcher(80),
}
KINECT = {
    "reference": ReferenceMatcher(),
    "finer": ReferenceMatcher(steps_per_px=0),
    "census": CensusMatcher(64, -24),
}


@pytest.fixture(scope="module")
def renderer():
    return MitsubaRenderer(samples=8)


def depth_errors(sensor, renderer, depths, half_m):
    """Errors in px of disparity, pooled over sub-pixel phases."""
    scale = sensor.focal_px * sensor.baseline_m
    for seed, depth in enumerate(depths):
        frame = scan(sensor, [square(depth, half_m)], renderer, seed)
        measured = middle(frame.depth_m)
        assert np.isfinite(measured).mean() > 0.95
        yield scale / measured[np.isfinite(measured)] - scale / depth


@pytest.mark.slow
@pytest.mark.parametrize("name", STEREO)
def test_planes_of_a_stereo_sensor_come_back(renderer, name):
    sensor = SpeckleStereo(
        width_px=540, height_px=540, focal_px=750.0, step_px=2, matcher=STEREO[name]
    )
    pooled = np.concatenate(list(depth_errors(sensor, renderer, np.linspace(2.9, 3.1, 8), 0.3)))
    assert abs(np.median(pooled)) < 0.02
    assert np.quantile(np.abs(pooled), 0.68) < 0.1


@pytest.mark.parametrize(
    "name", ["reference", "finer", pytest.param("census", marks=pytest.mark.slow)]
)
def test_planes_of_a_sensor_with_a_stored_pattern_come_back(renderer, name):
    sensor = ReferenceSpeckle(matcher=KINECT[name])
    pooled = np.concatenate(list(depth_errors(sensor, renderer, np.linspace(1.95, 2.05, 8), 0.1)))
    assert abs(np.median(pooled)) < 0.04
    assert np.quantile(np.abs(pooled), 0.68) < 0.15
