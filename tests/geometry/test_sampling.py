import hashlib
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

from qs3.geometry.sampling import farthest_point_sampling_np, surface_sample, unit_ball


def brute_fps(points: np.ndarray, n: int, start: int) -> np.ndarray:
    cloud = (points - points.mean(axis=0)).astype(np.float32)
    order, nearest = [start], np.full(len(cloud), np.inf, np.float32)
    while len(order) < n:
        nearest = np.minimum(nearest, np.square(cloud - cloud[order[-1]]).sum(1))
        nearest[order] = -1
        order.append(int(nearest.argmax()))
    return np.array(order)


def assert_farthest(points: np.ndarray, order: np.ndarray) -> None:
    """Every point was one of the farthest from those before it: leaves ties open."""
    nearest = np.full(len(points), np.inf)
    for before, index in pairwise(order):
        nearest = np.minimum(nearest, np.square(points - points[before]).sum(1))
        assert nearest[index] >= nearest.max() - 1e-5


@pytest.mark.parametrize("total", [1, 2, 95, 96, 150, 5000])
def test_fps_equals_brute_force(total: int) -> None:
    rng = np.random.default_rng(total)
    points = rng.standard_normal((total, 3)) * [1, 2, 0.3] + 5
    n = min(total, 300)
    for start in {0, total // 3, total - 1}:
        order = farthest_point_sampling_np(points, n, start)
        assert order.dtype == np.int64
        np.testing.assert_array_equal(order, brute_fps(points, n, start))


@pytest.mark.parametrize("total", [50, 400, 6000])
def test_fps_with_ties_and_copies(total: int) -> None:
    rng = np.random.default_rng(0)
    points = rng.integers(0, 8, (total, 3)).astype(float)  # on a grid: ties and copies
    n = min(total, 600)
    for start in (0, 7, total - 1):
        order = farthest_point_sampling_np(points, n, start)
        assert order[0] == start
        assert len(set(order.tolist())) == n
        assert_farthest(points, order)


@pytest.mark.parametrize(
    ("total", "digest"),
    [(50, "9df063848922e323"), (400, "6f3a0344953559d3"), (6000, "e57023413631a9c0")],
)
def test_ties_are_fpsamples(total: int, digest: str) -> None:
    """Recorded with fpsample 0.3.3: by its plain loop, and by 2^3 and 2^5 buckets."""
    points = np.random.default_rng(total).integers(0, 8, (total, 3)).astype(float)
    orders = [farthest_point_sampling_np(points, min(total, 600), k) for k in (0, 7, total - 1)]
    assert hashlib.sha256(np.concatenate(orders).astype("<i8").data).hexdigest()[:16] == digest


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_unit_ball(dtype: type) -> None:
    points = (np.random.default_rng(0).standard_normal((4, 50, 3)) * 7 + 3).astype(dtype)
    ball = unit_ball(points)
    assert ball.dtype == dtype
    np.testing.assert_allclose(ball.mean(axis=1), 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(ball, axis=2).max(axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(unit_ball(points[2]), ball[2], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(unit_ball(points * 9 - 4), ball, atol=1e-5)


def test_surface_sample_follows_area() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [3, 0, 5], [0, 1, 5]], float)
    faces = np.array([[0, 0, 1], [0, 1, 2], [1, 2, 1], [3, 4, 5], [5, 5, 5]])
    points = surface_sample(vertices, faces, 20_000, np.random.default_rng(0))
    upper = points[:, 2] == 5
    assert np.all(upper | (points[:, 2] == 0))
    assert abs(upper.mean() - 0.75) < 0.015  # areas 0.5 and 1.5
    lower = points[~upper]
    assert np.all(lower[:, :2] >= 0)
    assert np.all(lower[:, :2].sum(1) <= 1 + 1e-12)
    np.testing.assert_allclose(lower[:, :2].mean(0), 1 / 3, atol=0.015)  # the centroid
    again = surface_sample(vertices, faces, 20_000, np.random.default_rng(0))
    np.testing.assert_array_equal(points, again)


def test_sampling_does_not_import_torch() -> None:
    code = "import sys, qs3.geometry.sampling; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
