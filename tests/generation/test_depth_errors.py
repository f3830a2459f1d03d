"""Errors that are taken out of depth again."""

from dataclasses import replace

import numpy as np

import qs3
from qs3.generation.recipes import DepthErrors
from qs3.geometry.cameras import Camera, Intrinsics
from qs3.meshes.mesh import merge
from qs3.sensors.base import DepthFrame
from tests.generation.generating import QUICK

NO_HOLES, NO_MIXED = DepthErrors(holes=False), DepthErrors(mixed_pixels=False)
NEITHER = DepthErrors(holes=False, mixed_pixels=False)


def step():
    """An object 1 m away on the left of a wall at 2 m, and nothing in the last column."""
    true = np.full((20, 41), 2.0, dtype=np.float32)
    true[:, :20], true[:, 40] = 1.0, np.inf
    label = np.zeros((20, 41), dtype=np.uint8)
    label[:, :20] = 1
    depth = np.where(np.isinf(true), np.nan, true + np.float32(0.01))
    depth[3, 5] = depth[3, 30] = np.nan  # a hole in the object, and one in the wall
    depth[8, 19], depth[9, 20] = 1.5, 1.4  # mixed, on both sides of the edge
    depth[10, 20:24] = 1.01  # the object made wider by a block
    depth[12, 30] = 1.01  # the object's depth, but far from it
    depth[14, 2] = 0.6  # before everything
    camera = Camera(Intrinsics.centred(41, 20, 100.0), np.eye(4))
    nothing = np.zeros_like(label)
    return DepthFrame(camera, 0, 0, 1, depth, true, label, true, nothing)


STRAY = {(8, 19), (9, 20), (12, 30), (14, 2)}


def test_mixed_pixels_are_those_that_no_surface_close_by_has():
    assert set(zip(*np.nonzero(NO_MIXED.mixed(step())), strict=True)) == STRAY
    left = NO_MIXED.left_in(step()).depth_m
    assert np.isnan(left[tuple(zip(*STRAY, strict=True))]).all()
    kept = ~NO_MIXED.mixed(step())
    np.testing.assert_array_equal(left[kept], step().depth_m[kept])


def test_holes_of_the_object_have_their_true_depth():
    before, after = step().depth_m, NO_HOLES.left_in(step()).depth_m
    assert after[3, 5] == 1.0
    assert np.isnan(after[3, 30])  # of the wall
    assert np.isnan(after[0, 40])  # nothing is there
    same = np.ones(before.shape, bool)
    same[3, 5] = False
    np.testing.assert_array_equal(after[same], before[same])


def test_without_both_a_mixed_pixel_is_not_filled():
    after = NEITHER.left_in(step()).depth_m
    assert after[3, 5] == 1.0
    assert np.isnan(after[8, 19])


def test_coarse_samples_reach_as_many_pixels():
    frame = replace(step(), step_px=4)  # 6 px are one sample
    errors = DepthErrors(mixed_pixels=False)
    assert errors.mixed(frame)[10, 21:24].all()  # wider by more than one sample
    assert not errors.mixed(frame)[10, 20]


# --- in a recipe


def test_what_stays_is_the_same_to_the_bit():
    from tests.generation.test_materials import stool

    solid = {"chair/train/one": merge([stool()]).to_trimesh()}
    words = ("domain=specklenet10", *QUICK, "views=1", "scene=room", "crop=mask")
    (plain,) = qs3.generate(solid, *words)["chair/train/one"].frames
    for left, errors in (("mixed_pixels", NO_HOLES), ("holes", NO_MIXED)):
        undone = ("depth_errors=neither", f"depth_errors.{left}=true")
        (frame,) = qs3.generate(solid, *words, *undone)["chair/train/one"].frames
        np.testing.assert_array_equal(frame.depth_m, errors.left_in(plain).depth_m)
        assert (frame.depth_m != plain.depth_m)[np.isfinite(frame.depth_m)].any() or (
            np.isnan(frame.depth_m) & np.isfinite(plain.depth_m)
        ).any()
