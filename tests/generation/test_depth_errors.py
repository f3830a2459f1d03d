"""Errors that are taken out of depth again, and the table that asks what they are worth."""

from dataclasses import replace

import cv2
import numpy as np

import qs3
from qs3.generation.plan import planned
from qs3.generation.recipes import DepthErrors
from qs3.geometry.cameras import Camera, Intrinsics
from qs3.meshes.mesh import merge
from qs3.sensors.base import DepthFrame
from qs3.sensors.devices.time_of_flight import TimeOfFlight
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.generation.generating import QUICK, composed
from tests.sensors.scenery import POSE, box_of, square

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


def test_all_errors_leave_the_frame_alone():
    frame = step()
    assert DepthErrors().left_in(frame) is frame


def test_coarse_samples_reach_as_many_pixels():
    frame = replace(step(), step_px=4)  # 6 px are one sample
    errors = DepthErrors(mixed_pixels=False)
    assert errors.mixed(frame)[10, 21:24].all()  # wider by more than one sample
    assert not errors.mixed(frame)[10, 20]


def test_flying_pixels_of_time_of_flight_are_found_at_its_edges():
    """That sensor mixes the light of both surfaces: a known place for mixed pixels."""
    sensor = TimeOfFlight(width_px=120, height_px=90, focal_px=110.0)
    near, far = square(1.5, 0.61), square(1.9, 2.0)
    box = box_of(square(1.5, 0.8))
    frame = sensor.scan(
        (near, replace(far, label=0)),
        box,
        POSE,
        MitsubaRenderer(samples=4),
        np.random.default_rng(0),
    )
    mixed = replace(NO_MIXED, apart_m=0.06).mixed(frame)  # its noise is 1 cm
    assert mixed.sum() > 10
    edge = np.abs(np.diff(frame.clean_m, axis=1, prepend=frame.clean_m[:, :1])) > 0.2
    edge |= np.abs(np.diff(frame.clean_m, axis=0, prepend=frame.clean_m[:1])) > 0.2
    close = cv2.dilate(edge.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert mixed[close].mean() > 5 * mixed[~close].mean()


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


def test_the_default_adds_no_key():
    for domain in ("specklenet10", "kinectsim10"):
        assert "depth_errors" not in planned(composed(f"domain={domain}"))._settings()["recipe"]
    off = planned(composed("domain=kinectsim10", "depth_errors=neither"))._settings()["recipe"]
    assert off["depth_errors"]["holes"] is False


# --- the table that asks what they are worth
