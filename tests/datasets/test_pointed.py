"""What is pointed at in a depth image, by a mask or a box, is the thing that was placed there."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from qs3.datasets.depth_images import Pinhole
from qs3.datasets.pointed import GIVEN, LEVEL, PLANES, point_out
from qs3.datasets.vertical import angle_deg, planes_up_steep
from qs3.errors import DataError
from tests.fixtures.frame_files import Shot, Thing, kinect

STEP_M = 0.06  # half a step of a Kinect's disparity and four sigma of noise at 3.5 m
ROOM = Shot(
    [Thing("chair", -0.6, 2.4, 35), Thing("cabinet", 0.8, 2.7, 25, 0.8)],
    pitch_deg=14,
    roll_deg=3,
)
CAMERA = Pinhole(*ROOM.camera)


def seen(shot=ROOM):
    """Noisy depth, and the number of the thing that each pixel shows, from 1."""
    depth, shown = shot.render()
    return kinect(depth, 1), np.maximum(shown + 1, 0)


def box_of(mask, around=5):
    v, u = np.nonzero(mask)
    return u.min() - around, v.min() - around, u.max() + 1 + around, v.max() + 1 + around


def test_each_number_of_a_mask_is_one_object_and_lies_on_its_thing():
    depth, mask = seen()
    mask = np.where(mask == 2, 7, mask)
    found = point_out(depth, CAMERA, mask=mask, up=9.81 * ROOM.up_in_camera)
    assert [one.name for one in found] == ["[1]", "[7]"]
    for one, thing in zip(found, ROOM.things, strict=True):
        where = ROOM.to_world(one.piece.points_m.astype(float))
        assert thing.distance(where).max() < STEP_M
        assert len(where) > 0.8 * ((one.mask) & (depth > 0)).sum()
        assert (one.tier, one.cautions, one.up, one.why) == ("clean", (), GIVEN, "")
        assert one.without_depth == (one.mask & (depth == 0)).sum() > 0
    (bare,) = point_out(depth, CAMERA, mask=mask == 7, up=ROOM.up_in_camera)
    assert bare.name == ""
    np.testing.assert_array_equal(bare.piece.points_m, found[1].piece.points_m)


@pytest.mark.parametrize("cls", ["chair", "table", "sofa", "monitor", "plant"])
def test_a_box_holds_its_thing_without_floor_wall_and_neighbours(cls):
    size = {"sofa": 0.7, "table": 0.8}.get(cls, 0.9)
    shot = Shot(
        [
            Thing(cls, -0.3, 2.6, 30, size, z=0.6 if cls == "monitor" else 0),
            Thing("toy", -0.05, 3.6, boxes=((0, 0, 0.3, 0.4, 0.4, 0.6),)),  # behind, in the box
        ],
        pitch_deg=18,
        roll_deg=-3,
    )
    depth, mask = seen(shot)
    (one,) = point_out(depth, CAMERA, box=box_of(mask == 1), up=shot.up_in_camera)
    own, right = one.mask & (depth > 0), (mask == 1) & (depth > 0)
    assert (own & ~right).sum() < 0.01 * own.sum()
    assert (own & right).sum() > 0.9 * right.sum()
    assert shot.things[0].distance(shot.to_world(one.piece.points_m.astype(float))).max() < STEP_M
    assert one.tier == "clean"


def test_a_box_of_nothing_but_background_is_cautioned():
    depth, _ = seen(Shot([], pitch_deg=15))
    (wall,) = point_out(depth, CAMERA, box=(200, 20, 320, 100), up=(0, -1, -0.2))
    assert [caution.kind for caution in wall.cautions] == ["box"]
    assert wall.tier == "hard"
    (floor,) = point_out(depth, CAMERA, box=(200, 400, 320, 460), up=Shot([]).up_in_camera)
    assert "box" in [caution.kind for caution in floor.cautions]


def test_what_is_cut_off_covered_or_small_is_cautioned_and_still_there():
    cut_off = Shot([Thing("chair", 1.45, 2.2, 20)], pitch_deg=12)
    depth, mask = seen(cut_off)
    (one,) = point_out(depth, CAMERA, mask=mask, up=cut_off.up_in_camera)
    assert one.tier == "poor"
    assert "cut off" in [caution.kind for caution in one.cautions]
    assert len(one.piece.points_m) > 700
    covered = Shot(
        [
            Thing("sofa", 0.0, 3.2, 25, 0.8),
            Thing("toy", 0.05, 1.9, boxes=((0, 0, 0.3, 0.5, 0.3, 0.6),)),
        ]
    )
    depth, mask = seen(covered)
    (one,) = point_out(depth, CAMERA, mask=mask == 1, up=covered.up_in_camera)
    assert one.tier == "hard"
    assert [caution.kind for caution in one.cautions] == ["covered"]
    far = Shot([Thing("lamp", 0, 5.5, size=0.4)], wall_m=7)
    depth, mask = seen(far)
    (one,) = point_out(depth, CAMERA, mask=mask, up=far.up_in_camera)
    assert one.cautions[0].words == f"{len(one.piece.points_m)} pixels with depth, fewer than 700"


@pytest.mark.parametrize("off_deg", [0.0, 15.0, 30.0, 60.0])
def test_an_up_that_the_planes_contradict_is_cautioned(off_deg):
    """Beyond 20 degrees, with what they say; the up that is given is used nevertheless."""
    depth, mask = seen()
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, np.deg2rad(off_deg)]))
    given = turn @ ROOM.up_in_camera
    (one,) = point_out(depth, CAMERA, mask=mask == 1, up=given)
    assert one.up == "given"
    said = [caution.words for caution in one.cautions if caution.kind == "up"]
    assert len(said) == (off_deg > 20)
    if said:
        x, y, z, off = map(float, re.search(r"up=(\S+),(\S+),(\S+), (\d+)°", said[0]).groups())
        assert abs(off - angle_deg(given, ROOM.up_in_camera)) < 3
        assert angle_deg(np.array([x, y, z]), ROOM.up_in_camera) < 3


def test_up_is_fitted_or_level_and_says_which():
    depth, mask = seen()
    fitted = point_out(depth, CAMERA, mask=mask)
    known = point_out(depth, CAMERA, mask=mask, up=ROOM.up_in_camera)
    assert {one.up for one in fitted} == {PLANES}
    assert not any(one.cautions for one in fitted)
    for a, b in zip(fitted, known, strict=True):
        np.testing.assert_allclose(a.piece.points_m[:, 2], b.piece.points_m[:, 2], atol=0.03)
    alone = np.where(mask == 1, depth, 0)
    (one,) = point_out(np.where(np.arange(640) % 3, 0, alone), CAMERA, mask=mask == 1)
    assert one.up == LEVEL
    assert "counts as level" in one.cautions[-1].words
    (down,) = point_out(depth, CAMERA, mask=mask == 1, up=-ROOM.up_in_camera)
    assert [caution.kind for caution in down.cautions] == ["up"]


@pytest.mark.parametrize("size", [(480, 640), (120, 160)])
@pytest.mark.parametrize("pitch_deg", [0, 15, 30, 45, 55, 70, 85])
def test_a_fitted_vertical_is_right_or_not_sure(pitch_deg, size):
    """A wall seen steeply from above looks like a floor: what is wrong must not be sure."""
    camera = tuple(size[0] / 480 * value for value in ROOM.camera)
    shot = Shot(
        [Thing("chair", -0.3, 2.4 if pitch_deg < 40 else 1.6, 35)],
        pitch_deg=pitch_deg,
        roll_deg=4,
        height_m=1.4 + pitch_deg / 60,
        size=size,
        camera=camera,
    )
    up, sure = planes_up_steep(seen(shot)[0], Pinhole(*camera))
    right = angle_deg(up, shot.up_in_camera) < 1.5
    assert right or not sure
    assert right or pitch_deg > 50
    assert sure or pitch_deg > 40


@pytest.mark.parametrize(
    "words",
    [
        {"mask": np.ones((4, 4), int)},
        {"mask": np.zeros((480, 640), int)},
        {"mask": np.ones((480, 640))},
        {"box": (5, 5, 5, 9)},
        {"box": (700, 5, 900, 9)},
        {"box": (0.3, 0.2, 0.6, 0.8)},  # fractions of the picture
        {"box": (5, 5, 90, 90), "up": (0, 0, 0)},
    ],
)
def test_what_points_at_nothing(words):
    with pytest.raises(DataError):
        point_out(seen()[0], CAMERA, **words)
