"""Cameras, poses and projection."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from qs3.geometry.cameras import Camera, Intrinsics, look_at, project, rotation_xyz

coordinates = st.tuples(*[st.floats(-5, 5, allow_subnormal=False)] * 3).map(np.array)
angles = st.tuples(*[st.floats(-4, 4, allow_subnormal=False)] * 3).map(np.array)


@settings(max_examples=40, deadline=None)
@given(angles=angles)
def test_rotations_are_about_x_then_y_then_z(angles: np.ndarray) -> None:
    expected = Rotation.from_euler("xyz", angles).as_matrix()
    np.testing.assert_allclose(rotation_xyz(angles), expected, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(eye=coordinates, target=coordinates)
def test_looking_at_something(eye: np.ndarray, target: np.ndarray) -> None:
    away = target - eye
    if np.linalg.norm(away) < 1e-3 or np.linalg.norm(away[:2]) < 1e-3:
        return
    pose = look_at(eye, target)
    right, down, forward = pose[:3, 0], pose[:3, 1], pose[:3, 2]
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(forward, away / np.linalg.norm(away), atol=1e-12)
    np.testing.assert_array_equal(pose[:3, 3], eye)
    np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])
    assert abs(right[2]) < 1e-12  # the horizon is level
    assert down[2] < 0  # and the sky above


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_looking_straight_up_or_down(side: float) -> None:
    pose = look_at(np.zeros(3), np.array([0, 0, side]))
    np.testing.assert_array_equal(pose[:3, :3].T, [[1, 0, 0], [0, side, 0], [0, 0, side]])
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


@settings(max_examples=40, deadline=None)
@given(eye=coordinates, angles=angles, point=coordinates)
def test_projection_is_that_of_a_pinhole(
    eye: np.ndarray, angles: np.ndarray, point: np.ndarray
) -> None:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_xyz(angles), eye
    camera = Camera(Intrinsics(640, 480, 500.0, 300.0, 250.0), pose)
    x, y, z, _ = np.linalg.inv(pose) @ [*point, 1.0]
    pixel, depth = project(point[None], camera)
    assert depth[0] == pytest.approx(z, abs=1e-9)
    if abs(z) > 1e-2:
        expected = [500 * x / z + 300, 500 * y / z + 250]
        np.testing.assert_allclose(pixel[0], expected, rtol=1e-6, atol=1e-5)


def test_a_camera_moves_along_its_own_axes() -> None:
    camera = Camera(Intrinsics.centred(3, 3, 1.0), look_at(np.zeros(3), np.array([0.0, 1, 0])))
    moved = camera.moved((0.5, 0.25, 2.0))  # right is x, down is -z, forward is y
    np.testing.assert_allclose(moved.world_from_camera[:3, 3], [0.5, 2.0, -0.25], atol=1e-12)
    np.testing.assert_array_equal(moved.world_from_camera[:3, :3], camera.world_from_camera[:3, :3])
    assert not camera.world_from_camera[:3, 3].any()  # the first one stays
