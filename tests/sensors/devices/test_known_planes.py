"""Planes at known depths through the real renderer and the real matchers."""

import numpy as np
import pytest

from qs3.errors import ConfigError
from qs3.geometry.cameras import look_at
from qs3.meshes.mesh import Mesh
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.matching import ReferenceMatcher, StereoBlockMatcher
from qs3.sensors.renderers.base import Body
from qs3.sensors.renderers.mitsuba import MitsubaRenderer

POSE = look_at(np.zeros(3), np.array([1.0, 0.0, 0.0]))


@pytest.fixture(scope="module")
def renderer():
    return MitsubaRenderer(samples=8)


def plane(depth_m, half_m=0.5, tilt_deg=0.0):
    """A square at x = depth_m, turned about the vertical axis, as a body and its box."""
    angle = np.deg2rad(tilt_deg)
    side = np.array([np.sin(angle), np.cos(angle), 0.0]) * half_m
    up = np.array([0.0, 0.0, half_m])
    centre = np.array([depth_m, 0.0, 0.0])
    vertices = np.array(
        [centre - side - up, centre + side - up, centre + side + up, centre - side + up]
    )
    mesh = Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    return (Body(mesh),), np.stack([vertices.min(0), vertices.max(0)])


def middle(image, share=0.6):
    rows, cols = (round(n * (1 - share) / 2) for n in image.shape)
    return image[rows : image.shape[0] - rows, cols : image.shape[1] - cols]


STEREO = SpeckleStereo(
    width_px=540, height_px=540, focal_px=750.0, step_px=2, matcher=StereoBlockMatcher(80, 15)
)
KINECT = ReferenceSpeckle()


@pytest.mark.parametrize(
    ("sensor", "depths"),
    [(STEREO, np.linspace(2.9, 3.1, 8)), (KINECT, np.linspace(1.95, 2.05, 8))],
    ids=["stereo", "reference"],
)
def test_planes_come_back_at_their_depth(renderer, sensor, depths):
    """Pooled over sub-pixel phases, within a quarter of the sensor's depth step."""
    errors = []
    for seed, depth in enumerate(depths):
        bodies, box = plane(depth)
        frame = sensor.scan(bodies, box, POSE, renderer, np.random.default_rng(seed))
        np.testing.assert_allclose(middle(frame.clean_m), depth, rtol=1e-5)
        measured = middle(frame.depth_m)
        assert np.isfinite(measured).mean() > 0.95
        errors.append((measured - depth)[np.isfinite(measured)])
    pooled = np.concatenate(errors)
    step = sensor.depth_step_m(float(np.mean(depths)))
    assert abs(np.median(pooled)) < step / 4
    # One standard deviation is of the order of the step, not of ten.
    assert np.quantile(np.abs(pooled), 0.68) < 2 * step


@pytest.mark.parametrize("sensor", [STEREO, KINECT], ids=["stereo", "reference"])
def test_noise_grows_with_the_square_of_the_distance(renderer, sensor):
    spread = {}
    for depth in (1.5, 3.0):
        values = []
        for seed in range(6):
            bodies, box = plane(depth + 0.013 * seed)
            frame = sensor.scan(bodies, box, POSE, renderer, np.random.default_rng(seed))
            error = middle(frame.depth_m) - (depth + 0.013 * seed)
            values.append(error[np.isfinite(error)])
        pooled = np.concatenate(values)
        spread[depth] = np.subtract(*np.quantile(pooled, [0.84, 0.16])) / 2
    slope = np.log(spread[3.0] / spread[1.5]) / np.log(2)
    assert 1.6 < slope < 2.4


def test_back_projection_returns_to_the_plane(renderer):
    bodies, box = plane(3.0, tilt_deg=30)
    frame = STEREO.scan(bodies, box, POSE, renderer, np.random.default_rng(0))
    points = frame.points(frame.clean_m, POSE)
    normal = np.array([np.cos(np.deg2rad(30)), -np.sin(np.deg2rad(30)), 0.0])
    np.testing.assert_allclose((points - [3.0, 0, 0]) @ normal, 0, atol=2e-5)
    assert points[:, 2].max() == pytest.approx(0.5, abs=0.01)


def test_the_shadow_of_a_near_edge_is_as_wide_as_geometry_says(renderer):
    """Reference sensor: the projector is beside the camera, on its right."""
    near, far = 1.2, 2.4
    front, _ = plane(near, half_m=0.15)
    back, box = plane(far, half_m=0.8)
    frame = KINECT.scan((*front, *back), box, POSE, renderer, np.random.default_rng(0))
    row = frame.depth_m.shape[0] // 2
    hole = np.isnan(frame.depth_m[row - 10 : row + 10]).mean(axis=0) > 0.5
    edges = np.flatnonzero(np.diff((frame.clean_m[row] < 2).astype(int)))
    left, right = edges[0], edges[-1]
    width = KINECT.focal_px * KINECT.baseline_m * (1 / near - 1 / far)
    # Light comes from the right, so the shadow falls to the left of the near square.
    shadow = hole[left - int(width) - 20 : left + 5].sum()
    assert shadow == pytest.approx(width, abs=KINECT.matcher.window_px)
    assert hole[right + 6 : right + 6 + int(width)].sum() <= 3


def test_nothing_in_view_is_none_and_nothing_matched_is_empty(renderer):
    bodies, box = plane(3.0)
    away = look_at(np.zeros(3), np.array([-1.0, 0.0, 0.0]))
    assert STEREO.scan(bodies, box, away, renderer, np.random.default_rng(0)) is None
    bodies, box = plane(9.0)  # beyond max_depth_m
    frame = STEREO.scan(bodies, box, POSE, renderer, np.random.default_rng(0))
    assert np.isfinite(frame.depth_m).mean() < 0.02


def test_a_frame_is_the_same_bytes_each_time(renderer):
    bodies, box = plane(2.5, tilt_deg=20)
    for sensor in (STEREO, KINECT):
        a, b = (
            sensor.scan(bodies, box, POSE, renderer, np.random.default_rng(7)) for _ in range(2)
        )
        assert a.depth_m.tobytes() == b.depth_m.tobytes()
        assert a.images["left"].tobytes() == b.images["left"].tobytes()


def test_ranges_that_contradict_each_other_are_refused():
    with pytest.raises(ConfigError, match=r"nearer than the matcher reaches.*1\.88 m"):
        SpeckleStereo(matcher=StereoBlockMatcher(80, 19))
    with pytest.raises(ConfigError, match=r"the matcher searches -24 to -1"):
        ReferenceSpeckle(matcher=ReferenceMatcher(num_disparities=24))
