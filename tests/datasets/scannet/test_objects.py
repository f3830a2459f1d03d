"""Viewpoints and sampling."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.datasets.scannet.objects import Sightings, sampled, spread


def circle(degrees, radius=2.0):
    angle = np.deg2rad(degrees)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)


def test_the_directions_taken_are_far_apart():
    """A long stay in one corner, a quick walk about: the stay gets one viewpoint, not eight."""
    degrees = np.concatenate([np.linspace(0, 3, 80), np.arange(45, 360, 45)])
    points = np.full(len(degrees), 2000)
    points[7] = 5000
    chosen = spread(circle(degrees), points, 8)
    assert chosen[0] == 7
    assert sum(i < 80 for i in chosen) == 1
    assert sorted(chosen[1:]) == list(range(80, 87))


def test_distance_from_the_object_does_not_count():
    near = np.concatenate([circle(np.array([0.0])), circle(np.array([0.0]), 50.0)])
    towards = np.concatenate([near, circle(np.array([90.0]))])
    assert spread(towards, [9, 1, 1], 2) == [0, 2]


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 40), count=st.integers(1, 12))
def test_each_next_one_is_the_farthest(seed, n, count):
    rng = np.random.default_rng(seed)
    towards = rng.normal(size=(n, 3))
    points = rng.integers(1001, 1010, n)
    chosen = spread(towards, points, count)
    assert len(chosen) == len(set(chosen)) == min(n, count)
    assert chosen[0] == list(points).index(max(points))
    unit = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    for k in range(1, len(chosen)):
        gaps = [min(np.linalg.norm(unit[i] - unit[j]) for j in chosen[:k]) for i in range(n)]
        assert gaps[chosen[k]] >= max(gaps) - 1e-12


def test_frames_at_one_place_are_all_taken_once():
    assert sorted(spread(np.ones((5, 3)), [1, 2, 2, 1, 1], 4)) == [0, 1, 2, 3]
    assert spread(np.zeros((2, 3)), [1, 1], 5) == [0, 1]


def test_only_more_than_enough_points_make_a_sighting():
    sightings = Sightings()
    for frame, count in ((4, 999), (9, 1000), (12, 1001), (15, 1500)):
        sightings.see(frame, np.full((count, 3), 0.5), np.array([frame, 0.0, 0.0]), 1000)
    assert sightings.frames == [12, 15]
    assert sightings.most == (1500, 15)
    assert sightings.viewpoints(10) == (12, 15)
    assert sightings.viewpoints(1) == (15,)
    assert Sightings().viewpoints(10) == ()


def test_sampling_keeps_measured_points_and_fills_up():
    cloud = np.random.default_rng(0).normal(size=(300, 3))
    few = sampled(cloud, 100)
    assert few.dtype == np.float32
    assert few.shape == (100, 3)
    assert len(np.unique(few, axis=0)) == 100
    every = {tuple(p) for p in cloud.astype(np.float32)}
    assert {tuple(p) for p in few} <= every
    full = sampled(cloud, 700)
    assert {tuple(p) for p in full} == every
