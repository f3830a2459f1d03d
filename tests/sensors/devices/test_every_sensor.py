"""What every kind of sensor must do, through the real renderers."""

import numpy as np
import pytest

from qs3.geometry.cameras import look_at
from qs3.sensors.devices.blensor_kinect import DotMask
from qs3.sensors.devices.fitted import FittedDepth
from qs3.sensors.devices.fringe import FringeCode, FringeProjection
from qs3.sensors.devices.gaussian_time_of_flight import GaussianTimeOfFlight
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.devices.time_of_flight import TimeOfFlight
from qs3.sensors.matching import StereoBlockMatcher
from qs3.sensors.optics.visibility import Reason
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.scenery import POSE, box_of, middle, plane, scan, square

SENSORS = {
    "stereo": SpeckleStereo(
        width_px=540, height_px=540, focal_px=750.0, step_px=2, matcher=StereoBlockMatcher(80, 15)
    ),
    "reference": ReferenceSpeckle(),
    "time of flight": TimeOfFlight(lamp_offset_m=0.1),
    "BlenSor's time of flight": GaussianTimeOfFlight(step_px=2),
    "BlenSor's Kinect": DotMask(step_px=3),
    "fringes": FringeProjection(code=FringeCode((1.0, 16.0), steps=3)),
    "fitted": FittedDepth(baseline_m=0.075, step_px=2, cx_px=300.0, noise_factor=0.0005),
}


@pytest.mark.parametrize("name", SENSORS)
def test_a_frame_is_complete_and_the_same_bytes_each_time(name, renderer):
    sensor, body = SENSORS[name], plane(1.7, 0.2, tilt_deg=30)
    frame, again = (scan(sensor, [body], renderer, seed=4) for _ in range(2))
    explained = scan(sensor, [body], renderer, seed=4, explain=True)
    images = ("depth_m", "clean_m", "label", "cosine", "reason")
    for image in images:
        assert getattr(frame, image).tobytes() == getattr(again, image).tobytes()
    assert explained.depth_m.tobytes() == frame.depth_m.tobytes()
    assert {key: frame.images[key].tobytes() for key in frame.images} == {
        key: again.images[key].tobytes() for key in again.images
    }
    assert len({getattr(frame, image).shape for image in images}) == 1
    types = [getattr(frame, image).dtype for image in images]
    assert types == [np.float32, np.float32, np.uint8, np.float32, np.uint8]
    np.testing.assert_array_equal(np.isfinite(frame.depth_m), frame.reason == Reason.OK)
    assert np.isfinite(middle(frame.depth_m)).mean() > 0.9
    assert (middle(frame.label) == 1).all()
    # What is back-projected lies on the plane, which is turned by 30 degrees.
    points = frame.points(frame.clean_m, POSE)
    normal = np.array([np.cos(np.deg2rad(30)), -np.sin(np.deg2rad(30)), 0.0])
    np.testing.assert_allclose((points - [1.7, 0, 0]) @ normal, 0, atol=2e-5)
    assert points[:, 2].max() == pytest.approx(0.2, abs=0.02)
    grid = sensor.step_px // 2 if frame.step_px > 1 else 0
    assert (frame.left % frame.step_px, frame.top % frame.step_px) == (grid, grid)
    away = look_at(np.zeros(3), np.array([-1.0, 0.0, 0.0]))
    rng = np.random.default_rng(0)
    assert sensor.scan((body,), box_of(body), away, renderer, rng) is None


@pytest.mark.parametrize(
    ("name", "source_m", "slack_px"),
    [
        ("stereo", 0.05, 9),  # a block's fattening covers a part of it
        ("reference", 0.075, 6),
        ("time of flight", 0.1, 1.5),
        pytest.param("BlenSor's Kinect", 0.075, 7, marks=pytest.mark.slow),  # spread by 3 px
        pytest.param("fringes", 0.15, 2.5, marks=pytest.mark.slow),
        pytest.param("fitted", 0.075, 2.5, marks=pytest.mark.slow),
    ],
)
def test_the_projectors_shadow_is_as_wide_as_geometry_says(name, source_m, slack_px, renderer):
    """A pixel that is lit in part counts as lit."""
    sensor, near, far = SENSORS[name], 1.2, 2.4
    frame = scan(sensor, [square(near, 0.15), square(far, 0.7)], renderer, explain=True)
    shadow, front = frame.reason == Reason.SHADOW, frame.clean_m < 2
    rows = np.flatnonzero(front.any(axis=1))
    inner = slice(rows[len(rows) // 4], rows[3 * len(rows) // 4])
    width = shadow[inner].sum(axis=1).mean() * frame.step_px
    expected = sensor.focal_px * source_m * (1 / near - 1 / far)
    assert expected - slack_px < width < expected + 2.5
    # Light comes from the right, the shadow falls to the left.
    assert np.nonzero(shadow[inner])[1].max() <= np.nonzero(front[inner])[1].min() + 1
    assert np.isnan(frame.depth_m[frame.reason == Reason.SHADOW]).all()
    if frame.step_px == 1:
        assert not frame.images["lit"][frame.reason == Reason.SHADOW].any()


@pytest.mark.blender
@pytest.mark.parametrize(
    ("sensor", "tolerance_m"),
    [
        (TimeOfFlight(width_px=160, height_px=144, focal_px=126.0), 2e-4),
        (GaussianTimeOfFlight(), 1e-5),
        (DotMask(), 1e-5),
        pytest.param(
            FringeProjection(code=FringeCode((1.0, 16.0), steps=3)), 6e-3, marks=pytest.mark.slow
        ),
    ],
    ids=["time of flight", "BlenSor's time of flight", "BlenSor's Kinect", "fringes"],
)
def test_both_renderers_give_the_same_depth(sensor, tolerance_m):
    """For sensors that match no images; the same noise is drawn."""
    bodies = [square(1.0, 0.08), square(1.6, 0.3)]
    a, b = (
        scan(sensor, bodies, make(samples=4), box=box_of(bodies[1]))
        for make in (MitsubaRenderer, BlenderRenderer)
    )
    both = np.isfinite(a.depth_m) & np.isfinite(b.depth_m)
    assert both.mean() > 0.6
    assert (np.isfinite(a.depth_m) != np.isfinite(b.depth_m)).mean() < 0.02
    # Edges may fall to the other side.
    difference = np.abs(a.depth_m[both] - b.depth_m[both])
    assert np.quantile(difference, 0.95) < tolerance_m
    assert (a.reason != b.reason).mean() < 0.03
