"""Up is found by the floor, and by a room's planes."""

import numpy as np
import pytest

from qs3.datasets.depth_images import Pinhole
from qs3.datasets.vertical import angle_deg, floor_up, planes_up, planes_up_steep
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


@pytest.mark.parametrize("pitch", [10, 20, 30])
@pytest.mark.parametrize("width", [640, 160])
def test_planes_of_small_pictures(width, pitch):
    """A floor 1.2 m below the camera and a wall 4.5 m before it, by a camera of 63 degrees."""
    height, focal = width * 3 // 4, 525 * width / 640
    camera = Pinhole(focal, focal, (width - 1) / 2, (height - 1) / 2)
    angle = np.deg2rad(pitch)
    up, ahead = np.array([0, -np.cos(angle), -np.sin(angle)]), [0, -np.sin(angle), np.cos(angle)]
    rays = camera.rays(height, width)
    floor, wall = 1.2 / np.maximum(-(rays @ up), 1e-9), 4.5 / np.maximum(rays @ ahead, 1e-9)
    depth = np.minimum(floor, wall)
    rng = np.random.default_rng(0)
    depth += 0.005 * rng.normal(size=depth.shape)
    depth[rng.random(depth.shape) < 0.05] = 0  # all over the picture, mostly single pixels
    found, sure = planes_up_steep(depth, camera)
    assert sure
    assert angle_deg(found, up) < 1
