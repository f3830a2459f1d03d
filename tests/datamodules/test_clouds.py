from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.datamodules.clouds import Clouds
from qs3.geometry.sampling import unit_ball

STORED = np.random.default_rng(0).normal(size=(5, 40, 3)).astype(np.float32) * [3, 1, 0.1] + 7
STORED = STORED.astype(np.float32)
ORDER = np.stack([np.random.default_rng(i).permutation(40)[:8] for i in range(10)])
ORDER = ORDER.reshape(5, 2, 8).astype(np.int16)


@pytest.fixture
def mapped(tmp_path) -> Clouds:
    np.save(tmp_path / "stored.npy", STORED)
    np.save(tmp_path / "order.npy", ORDER)
    return Clouds.of(
        np.load(tmp_path / "stored.npy", mmap_mode="r"),
        np.load(tmp_path / "order.npy", mmap_mode="r"),
    )


def test_batch_equals_the_normalised_clouds_to_the_bit(mapped):
    index, start = torch.tensor([3, 0, 3]), torch.tensor([1, 0, 0])
    batch = mapped.take(index, start)
    assert batch.dtype == torch.float32
    for points, i, s in zip(batch.numpy(), (3, 0, 3), (1, 0, 0), strict=True):
        assert np.array_equal(points, unit_ball(STORED[i])[ORDER[i, s]])


def test_in_metres_clouds_are_centred_and_keep_their_size():
    corners = np.array([[0, 0, 0], [4, 0, 0], [0, 2, 0], [4, 2, 0]], dtype=np.float32)
    stored = np.stack([corners, 2 * corners]) + np.float32(8)
    about = np.array([[-2, -1, 0], [2, -1, 0], [-2, 1, 0], [2, 1, 0]], dtype=np.float32)
    clouds = Clouds.of(stored, scale="metres")
    assert np.array_equal(clouds.points.numpy(), [about, 2 * about])
    np.testing.assert_allclose(clouds.radius, [5**0.5, 20**0.5], rtol=1e-6)
    order = np.array([[[3, 0]], [[1, 2]]], dtype=np.int16)
    some = Clouds.of(stored, order, "metres").at(np.array([1])).take(torch.tensor([0]))
    assert np.array_equal(some.numpy(), 2 * about[None, [1, 2]])
    ball = replace(clouds, scale="unit_ball")
    assert ball.stored is clouds.stored
    assert np.array_equal(ball.points.numpy(), unit_ball(stored))


def test_above_the_floor_clouds_keep_their_height_and_no_other_place():
    corners = np.array([[0, 0, 0], [4, 0, 0], [0, 2, 1], [4, 2, 1]], dtype=np.float32)
    stored = np.stack([corners, 2 * corners]) + np.float32([8, 8, -0.75])
    clouds = Clouds.of(stored, scale="above_floor", floor=-1.25)
    about = np.array([[-2, -1, 0.5], [2, -1, 0.5], [-2, 1, 1.5], [2, 1, 1.5]])
    assert np.array_equal(clouds.points[0].numpy(), about)
    assert clouds.points[1, :, 2].tolist() == [0.5, 0.5, 2.5, 2.5]
    order = np.array([[[3, 0]], [[1, 2]]], dtype=np.int16)
    some = Clouds.of(stored, order, "above_floor", -1.25).at(np.array([0])).points
    assert np.array_equal(some[0].numpy(), about[[3, 0]])


def test_clouds_are_turned_as_their_camera_at_the_origin_sees_them():
    points = np.float32([[3, 3, 1], [3, 5, 1], [5, 3, 1], [5, 5, 4]])  # (4, 4) is its middle
    stored = np.stack([points, points * np.float32([1, -1, 1])])
    seen = Clouds.of(stored, scale="seen", floor=0.5).points.numpy()
    r = 2**0.5  # the nearest, the left one, the right one, the farthest
    expected = [[0, -r, 0.5], [-r, 0, 0.5], [r, 0, 0.5], [0, r, 3.5]]
    np.testing.assert_allclose(seen[0], expected, atol=1e-6)
    np.testing.assert_allclose(seen[1], np.multiply(expected, [-1, 1, 1]), atol=1e-6)


def test_a_batch_is_a_copy(mapped):
    mapped.take(torch.tensor([1])).zero_()
    assert np.array_equal(mapped.stored, STORED)
    whole = Clouds.of(STORED.copy())
    whole.take(torch.tensor([1])).zero_()
    assert np.array_equal(whole.stored, STORED)
