"""Depth pixels on masks against a plain twin; which viewpoints of an object are taken."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.datasets.scannet import Registration, agreed, spread
from qs3.datasets.scannet_files import SensHeader
from tests.datasets.rooms import BASE_FROM_COLOUR, BASE_FROM_DEPTH, rigid

DEPTH_SHAPE, COLOUR_SHAPE = (30, 40), (72, 96)


def header(base_from_depth=None, base_from_colour=None, colour=COLOUR_SHAPE, fy=95.0):
    """A depth camera of f = 40 px and a colour camera of about twice that, not square."""
    return SensHeader(
        colour_intrinsics=np.array([[96.0, 0, 47.0], [0, fy, 36.5], [0, 0, 1]]),
        depth_intrinsics=np.array([[40.0, 0, 19.5], [0, 39.0, 14.5], [0, 0, 1]]),
        colour_from_depth=np.linalg.inv(np.eye(4) if base_from_colour is None else base_from_colour)
        @ (np.eye(4) if base_from_depth is None else base_from_depth),
        colour_px=colour[::-1],
        depth_px=DEPTH_SHAPE[::-1],
        packed=True,
        depth_shift=1000.0,
        frames=1,
    )


def twin(head, depth, scale=1.0):
    """One pixel after the other, in words: the answer if nothing hides anything."""
    k, d = head.colour_intrinsics, head.depth_intrinsics
    height, width = (round(n * scale) for n in COLOUR_SHAPE)
    found = np.full(depth.shape, -1)
    for row in range(depth.shape[0]):
        for col in range(depth.shape[1]):
            z = depth[row, col]
            if not 0.1 <= z <= 10:
                continue
            local = [(col - d[0, 2]) / d[0, 0] * z, (row - d[1, 2]) / d[1, 1] * z, z, 1]
            there = head.colour_from_depth @ local
            if there[2] <= 0:
                continue
            u = k[0, 0] * there[0] / there[2] + k[0, 2]
            v = k[1, 1] * there[1] / there[2] + k[1, 2]
            # an image of other size has its edges, not its pixel centres, at the same places
            u, v = (u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5
            u, v = round(u), round(v)
            if 0 <= u < width and 0 <= v < height:
                found[row, col] = v * width + u
    return found


@pytest.mark.parametrize("scale", [1.0, 0.5, 2.0])
def test_a_plane_falls_where_the_twin_says(scale):
    head = header(BASE_FROM_DEPTH, BASE_FROM_COLOUR)
    rng = np.random.default_rng(0)
    depth = np.full(DEPTH_SHAPE, 2.0) + 0.01 * rng.random(DEPTH_SHAPE)
    depth[rng.random(DEPTH_SHAPE) < 0.1] = 0
    depth[3, 4:8] = [0.05, 11.0, 0.099, 10.1]  # out of the range
    depth = depth.astype(np.float32)
    shape = tuple(round(n * scale) for n in COLOUR_SHAPE)
    found = Registration(head, shape).mask_pixels(depth)
    np.testing.assert_array_equal(found, twin(head, depth, scale))
    assert (found >= 0).mean() > 0.7


def test_what_the_colour_camera_cannot_see_gets_no_pixel():
    """A post at 1 m before a wall at 3 m: 0.1 m to the left it hides another part of the wall."""
    head = header(base_from_colour=rigid((0, 0, 0), (-0.1, 0, 0)))
    depth = np.full(DEPTH_SHAPE, 3.0, dtype=np.float32)
    depth[:, 15:20] = 1.0
    found = Registration(head, COLOUR_SHAPE).mask_pixels(depth)
    free = twin(head, depth)  # as if nothing hid anything
    rows = slice(2, -2)  # inside the colour image
    found, free = found[rows], free[rows]
    post = np.zeros(free.shape, dtype=bool)
    post[:, 15:20] = True
    np.testing.assert_array_equal(found[post], free[post])
    # The colour camera's columns that show the post, and the wall that would fall among them.
    low, high = free[post].reshape(-1, 5).min(axis=1), free[post].reshape(-1, 5).max(axis=1)
    hidden = ~post & (free >= low[:, None]) & (free <= high[:, None])
    assert (hidden.sum(axis=1) >= 2).all()  # 6.4 mask px of parallax are 2.7 depth px
    assert (found[hidden] == -1).all()
    # It costs the wall little beside what is hidden: at most two cells of two pixels a side.
    lost = ~post & (free >= 0) & (found == -1)
    assert (lost.sum(axis=1) <= hidden.sum(axis=1) + 8).all()
    kept = found >= 0
    np.testing.assert_array_equal(found[kept], free[kept])


def test_masks_of_another_shape_are_refused():
    with pytest.raises(AssertionError):
        Registration(header(), (96, 96))


def test_a_mask_s_edges_are_left_out():
    mask = np.array([[1, 1, 1, 2, 2, 2, 2]] * 4, dtype=np.uint16) * 300
    found = agreed(mask)
    assert found.dtype == mask.dtype
    np.testing.assert_array_equal(found, np.array([[1, 1, 0, 0, 2, 2, 2]] * 4) * 300)


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
        assert gaps[chosen[k]] >= max(gaps) - 1e-6


def test_frames_at_one_place_are_all_taken_once():
    chosen = spread(np.ones((5, 3)), [1, 2, 2, 1, 1], 4)
    assert (chosen[0], len({*chosen})) == (1, 4)
    assert spread(np.zeros((2, 3)), [1, 1], 5) == [0, 1]
