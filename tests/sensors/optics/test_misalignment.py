"""What calibration leaves: known shifts of known pictures, and what they do to depth."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.geometry.cameras import Window
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.optics.misalignment import Misalignment
from tests.sensors.scenery import middle, plane, scan

WHOLE = Window(0, 0, 200, 160)


def ramps():
    """Pictures whose grey value is the column and the row."""
    v, u = np.mgrid[:160, :200].astype(np.float32)
    return u, v


def shifts(lens):
    return [middle(lens.seen(ramp, WHOLE) - ramp) for ramp in ramps()]


def test_fields_shift_the_right_picture_alone_by_their_rms():
    lens = Misalignment(rows_px=0.4, columns_px=0.7, cell_px=6.0)
    along, across = shifts(lens)
    assert along.std() == pytest.approx(0.7, rel=0.15)
    assert across.std() == pytest.approx(0.4, rel=0.15)
    assert abs(np.corrcoef(along.ravel(), across.ravel())[0, 1]) < 0.2
    again = shifts(replace(lens, seed=1))[0]
    assert abs(np.corrcoef(along.ravel(), again.ravel())[0, 1]) < 0.2


def test_columns_that_do_not_meet_are_a_bias_of_the_depth(renderer):
    """A field that hardly changes over the plane: the same shift everywhere on it."""
    sensor = SpeckleStereo()
    lens = Misalignment(columns_px=1.5, cell_px=5000.0, seed=3)
    target = [plane(2.0, 0.1)]
    error = []
    for one in (sensor, replace(sensor, misalignment=lens)):
        frame = scan(one, target, renderer)
        fb = one.focal_px * one.baseline_m
        off = fb / middle(frame.depth_m) - fb / middle(frame.clean_m)
        error.append(np.nanmedian(off))
    ramp = np.arange(1080, dtype=np.float32)[None].repeat(3, 0)
    across = Window(0, 539, 1080, 3)
    moved = lens.seen(ramp, across)[1, 540] - 540
    assert abs(moved) > 0.3
    # Where the right picture shows what lies farther right, its disparity is larger.
    assert error[1] - error[0] == pytest.approx(moved, abs=0.1)
