"""Pictures of clouds without perspective."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.geometry.orthographic import AZIMUTH_DEG, ELEVATION_DEG, axes_of, project, unit


@pytest.mark.parametrize(
    ("azimuth", "elevation", "right", "up", "towards"),
    [
        (0, 0, [0, 1, 0], [0, 0, 1], [1, 0, 0]),
        (90, 0, [-1, 0, 0], [0, 0, 1], [0, 1, 0]),
        (0, 90, [0, 1, 0], [-1, 0, 0], [0, 0, 1]),
        (-90, 30, [1, 0, 0], [0, 0.5, 0.75**0.5], [0, -(0.75**0.5), 0.5]),
    ],
)
def test_where_the_viewer_stands(
    azimuth: float, elevation: float, right: list, up: list, towards: list
) -> None:
    np.testing.assert_allclose(axes_of(azimuth, elevation), [right, up, towards], atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(azimuth=st.floats(-360, 360), elevation=st.floats(-89, 89))
def test_axes_are_right_handed(azimuth: float, elevation: float) -> None:
    axes = axes_of(azimuth, elevation)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)


@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_a_cloud_in_a_picture(scale: float) -> None:
    """In the middle of its box, as large as the disc, the nearest last."""
    cloud = np.random.default_rng(0).random((50, 3)) * [1, 2, 3] * scale + [5, -2, 9]
    seen, depth, height = project(cloud)
    middle = cloud - (cloud.min(0) + cloud.max(0)) / 2
    middle /= max(np.linalg.norm(point) for point in middle)
    axes = axes_of(AZIMUTH_DEG, ELEVATION_DEG)
    far_to_near = sorted(middle.tolist(), key=lambda point: float(axes[2] @ point))
    np.testing.assert_allclose(seen, [axes[:2] @ point for point in far_to_near], atol=1e-9)
    assert (np.diff(depth) >= 0).all()
    assert (depth[0], depth[-1]) == (0, 1)
    z = np.array(far_to_near)[:, 2]
    np.testing.assert_allclose(height, (z - z.min()) / (z.max() - z.min()), atol=1e-9)


def test_copies_of_one_point() -> None:
    seen, depth, height = project(np.ones((4, 3)))
    for values in (seen, depth, height):
        assert not values.any()


def test_stretched_to_0_and_1() -> None:
    assert unit(np.array([2.0, 6.0, 3.0])).tolist() == [0.0, 1.0, 0.25]
    assert unit(np.array([7.0, 7.0])).tolist() == [0.0, 0.0]
