"""Sensors without matching give the same depth with Blender and with Mitsuba."""

import numpy as np
import pytest

from qs3.sensors.devices.blensor_kinect import DotMask
from qs3.sensors.devices.fringe import FringeProjection
from qs3.sensors.devices.gaussian_time_of_flight import GaussianTimeOfFlight
from qs3.sensors.devices.time_of_flight import TimeOfFlight
from qs3.sensors.optics.fringe_code import FringeCode
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.scenery import box_of, scan, square

SENSORS = {
    "time of flight": (TimeOfFlight(width_px=160, height_px=144, focal_px=126.0), 2e-4),
    "BlenSor's time of flight": (GaussianTimeOfFlight(), 1e-5),
    "BlenSor's Kinect": (DotMask(), 1e-5),
    "fringes": (FringeProjection(code=FringeCode((1.0, 16.0), steps=3)), 6e-3),
}


@pytest.mark.parametrize("name", SENSORS)
def test_both_renderers_give_the_same_depth(name):
    sensor, tolerance_m = SENSORS[name]
    bodies = [square(1.0, 0.08), square(1.6, 0.3)]
    a, b = (
        scan(sensor, bodies, make(samples=4), box=box_of(bodies[1]))
        for make in (MitsubaRenderer, BlenderRenderer)
    )
    both = np.isfinite(a.depth_m) & np.isfinite(b.depth_m)
    assert both.mean() > 0.6
    assert (np.isfinite(a.depth_m) != np.isfinite(b.depth_m)).mean() < 0.02
    # The same noise is drawn; edges may fall to the other side.
    difference = np.abs(a.depth_m[both] - b.depth_m[both])
    assert np.quantile(difference, 0.95) < tolerance_m
    assert (a.reason != b.reason).mean() < 0.03
