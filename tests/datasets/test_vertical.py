"""Up is found by the floor, and by a room's planes."""

import numpy as np
import pytest

from qs3.datasets.depth_images import Pinhole
from qs3.datasets.vertical import angle_deg, floor_up, planes_up
from tests.fixtures.frame_files import Shot, Thing, kinect

TILTS = [(5, 0), (14, 3), (25, -4), (-3, 6)]


def shot(pitch, roll):
    things = [Thing("chair", -0.5, 2.4, 35), Thing("table", 0.8, 3.0, 20, 0.8)]
    return Shot(things, pitch_deg=pitch, roll_deg=roll)


@pytest.mark.parametrize(("pitch", "roll"), TILTS)
def test_floor(pitch, roll):
    one = shot(pitch, roll)
    depth, shown = one.render()
    up = floor_up(kinect(depth, 1), Pinhole(*one.camera), shown == -1)
    assert angle_deg(up, one.up_in_camera) < 0.3


def test_a_floor_with_wrong_labels_and_none_at_all():
    one = shot(14, 3)
    depth, shown = one.render()
    wrong = (shown == -1) | (shown == 0)  # the chair is labelled as floor, too
    assert angle_deg(floor_up(kinect(depth, 1), Pinhole(*one.camera), wrong), one.up_in_camera) < 1
    assert floor_up(depth, Pinhole(*one.camera), np.zeros_like(wrong)) is None
    assert floor_up(depth, Pinhole(*one.camera), shown == -2) is None  # a wall


@pytest.mark.parametrize(("pitch", "roll"), TILTS)
def test_planes(pitch, roll):
    one = shot(pitch, roll)
    up = planes_up(kinect(one.render()[0], 1), Pinhole(*one.camera))
    assert angle_deg(up, one.up_in_camera) < 2.5
    assert planes_up(np.zeros((60, 80)), Pinhole(*one.camera)) is None
