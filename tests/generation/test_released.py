"""What released=yes does, part by part."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.generation.released import GrowingJitterViews, box_of_corners, euler_xyz
from qs3.geometry.cameras import look_at, project, rotation_xyz
from qs3.meshes.mesh import Mesh
from qs3.meshes.placement import UnitCube
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.renderers.base import Body
from qs3.sensors.renderers.mitsuba import MitsubaRenderer

BOX = np.array([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]])


@pytest.fixture(scope="module")
def renderer():
    return MitsubaRenderer(samples=1)


@settings(deadline=None)
@given(
    st.tuples(*[st.floats(-3, 3)] * 3).filter(lambda e: np.linalg.norm(e) > 0.1),
)
def test_euler_angles_give_their_rotation_back(angles):
    rotation = rotation_xyz(np.array(angles))
    np.testing.assert_allclose(rotation_xyz(euler_xyz(rotation)), rotation, atol=1e-9)


def test_the_views_follow_the_released_law():
    views = GrowingJitterViews()
    poses = np.array([views.poses(np.random.default_rng(i), BOX) for i in range(3000)])
    eyes = poses[:, :, :3, 3]
    distance = np.linalg.norm(eyes[:, 0], axis=1)
    assert 3 <= distance.min() < 3.01
    assert 4.99 < distance.max() <= 5
    azimuth = np.degrees(np.arctan2(eyes[:, 0, 1], eyes[:, 0, 0]))
    assert -90 <= azimuth.min() < -89
    assert 89 < azimuth.max() <= 90
    angles = np.array([[euler_xyz(p[:3, :3] @ np.diag([1, -1, -1])) for p in v] for v in poses])
    for i in range(1, 5):
        shift = eyes[:, i] - eyes[:, 0]
        turn = (angles[:, i] - angles[:, 0] + np.pi) % (2 * np.pi) - np.pi
        for values, sigma in ((shift, 0.01 * (i + 1)), (turn, 0.02 * (i + 1))):
            assert np.abs(values).max() <= 0.1 + 1e-9
            # the quartile of a normal law is not touched by the clipping
            quartile = np.quantile(np.abs(values), 0.5, axis=0)
            np.testing.assert_allclose(quartile / (0.6745 * sigma), 1, atol=0.07)


def diamond():
    """Its own box is far larger than itself when it is turned by 45 degrees."""
    vertices = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 2.0]])
    return Mesh(
        vertices + np.array([50, 7, -3]), np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    )


@settings(deadline=None)
@given(st.integers(0, 2**31))
def test_the_loose_box_is_that_of_the_turned_corners(seed):
    mesh = diamond()
    placed = UnitCube().place(mesh, np.random.default_rng(seed))
    box = box_of_corners(mesh, placed)
    # by hand: the same random yaw
    yaw = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    half = 0.5 * (abs(np.cos(yaw)) + abs(np.sin(yaw)))
    np.testing.assert_allclose(box, [[-half, -half, -0.5], [half, half, 0.5]], atol=1e-9)
    assert (box[0] <= placed.bounds[0] + 1e-9).all()
    assert (box[1] >= placed.bounds[1] - 1e-9).all()


def square(depth_m, pose, half_m=0.2):
    right, down, forward, centre = pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3]
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    vertices = np.array(
        [centre + depth_m * forward + half_m * (a * right + b * down) for a, b in corners]
    )
    mesh = Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    return (Body(mesh),), mesh.bounds


POSE = look_at(np.array([0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))


def test_the_grid_error_shifts_the_cloud_by_half_a_pixel(renderer):
    depth = 4.0
    bodies, box = square(depth, POSE)
    right = SpeckleStereo(sample_offset_px=0)
    wrong = SpeckleStereo(sample_offset_px=0, centre_error_px=0.5)
    a, b, middle = (
        sensor.scan(bodies, box, POSE, renderer, np.random.default_rng(0))
        for sensor in (right, wrong, SpeckleStereo())
    )
    assert middle.left % 4 == middle.top % 4 == 2  # by default the middle of each step
    assert a.left % 4 == a.top % 4 == 0
    np.testing.assert_array_equal(a.depth_m, b.depth_m)
    moved = (b.points(b.clean_m, POSE) - a.points(a.clean_m, POSE)) @ POSE[:3, :3]
    shift = 0.5 * depth / 1500
    np.testing.assert_allclose(moved, np.broadcast_to([-shift, -shift, 0], moved.shape), atol=1e-6)
    # As the released code computes it: column ix of the small image, centre 135, focal 375.
    pixel, _ = project(b.points(b.clean_m, POSE)[:1], a.camera)
    _, col = np.argwhere(np.isfinite(b.clean_m))[0]
    ix = (b.left + col * 4) / 4
    assert (pixel[0, 0] - a.camera.intrinsics.cx_px) / 1500 == pytest.approx((ix - 135) / 375)
