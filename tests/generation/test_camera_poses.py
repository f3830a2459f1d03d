import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.generation.camera_poses import AnchoredViews, Drift, HandheldViews
from qs3.geometry.cameras import Camera, Intrinsics, look_at, project

TARGET = np.array([0.3, -0.2, 0.4])
BOX = TARGET + np.array([[-0.3, -0.4, -0.5], [0.3, 0.4, 0.5]])
seeds = st.integers(0, 2**31)


def is_rigid(pose):
    rotation = pose[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])


@settings(max_examples=40, deadline=None)
@given(seed=seeds)
def test_the_anchor_obeys_the_papers_law(seed):
    anchor, *others = AnchoredViews().poses(np.random.default_rng(seed), BOX)
    assert len(others) == 4
    offset = anchor[:3, 3] - TARGET
    distance = np.linalg.norm(offset)
    assert 3 <= distance <= 5
    assert 20 <= np.rad2deg(np.arcsin(offset[2] / distance)) <= 50
    camera = Camera(Intrinsics.centred(101, 101, 100.0), anchor)
    pixel, depth = project(TARGET[None], camera)
    np.testing.assert_allclose(pixel, [[50, 50]], atol=1e-9)
    assert depth[0] == pytest.approx(distance)
    for pose in others:
        is_rigid(pose)
        assert (np.abs(pose[:3, 3] - anchor[:3, 3]) <= 0.1).all()
        turn = anchor[:3, :3].T @ pose[:3, :3]
        # Three turns of at most 0.1 rad make at most 0.1 * sqrt(3) and a little.
        assert np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)) <= 0.18


@settings(max_examples=40, deadline=None)
@given(seed=seeds)
def test_handheld_cameras_are_upright_and_near(seed):
    law = HandheldViews(count=6)
    for pose in law.poses(np.random.default_rng(seed), BOX):
        is_rigid(pose)
        # The footprint of 60 x 80 cm has a circle of radius 50 cm around it.
        assert 1.4 - 1e-9 <= np.linalg.norm(pose[:3, 3] - TARGET) <= 2.7
        assert pose[2, 0] == pytest.approx(0)  # the image's x axis is level
        assert pose[2, 1] < 0  # its y axis points down


def test_more_views_leave_the_first_ones_as_they_were():
    few = AnchoredViews(count=2).poses(np.random.default_rng(3), BOX)
    many = AnchoredViews(count=5).poses(np.random.default_rng(3), BOX)
    np.testing.assert_array_equal(few, many[:2])


def test_drift_starts_exact_and_grows_like_a_random_walk():
    poses = [look_at(np.array([2.0, 0, 1]), np.zeros(3))] * 26
    drift = Drift(shift_m=0.01)
    ends = []
    for seed in range(200):
        believed = drift.believed(poses, np.random.default_rng(seed))
        np.testing.assert_array_equal(believed[0], poses[0])
        ends.append(believed[25][:3, 3] - poses[0][:3, 3])
    assert np.std(ends) == pytest.approx(0.01 * np.sqrt(25), rel=0.1)
    exact = Drift().believed(poses, np.random.default_rng(0))
    np.testing.assert_allclose(exact, poses)
