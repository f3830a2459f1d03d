"""What calibration leaves: known shifts of known pictures, and what they do to depth."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.geometry.cameras import Intrinsics, Window
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.optics.misalignment import Misalignment
from tests.sensors.scenery import middle, plane, scan

K = Intrinsics.centred(200, 160, 180.0)
WHOLE = Window(0, 0, 200, 160)


def ramps():
    """Pictures whose grey value is the column and the row."""
    v, u = np.mgrid[:160, :200].astype(np.float32)
    return u, v


def shifts(lens, right):
    return [middle(lens.seen(ramp, WHOLE, K, right=right) - ramp) for ramp in ramps()]


def test_fields_shift_the_right_picture_alone_by_their_rms():
    lens = Misalignment(rows_px=0.4, columns_px=0.7, cell_px=6.0)
    for found in shifts(lens, right=False):
        np.testing.assert_allclose(found, 0, atol=1e-4)
    along, across = shifts(lens, right=True)
    assert along.std() == pytest.approx(0.7, rel=0.15)
    assert across.std() == pytest.approx(0.4, rel=0.15)
    assert abs(np.corrcoef(along.ravel(), across.ravel())[0, 1]) < 0.2
    again = shifts(replace(lens, seed=1), right=True)[0]
    assert abs(np.corrcoef(along.ravel(), again.ravel())[0, 1]) < 0.2


def test_a_ray_is_seen_where_the_radial_model_says():
    lens = Misalignment(k1=-0.08, k2=0.01)
    u, v = (lens.seen(ramp, WHOLE, K, right=False) for ramp in ramps())
    for column, row in ((150, 120), (60, 40), (100, 30)):
        # The ideal place that is seen here, distorted, is here.
        x, y = (u[row, column] - K.cx_px) / K.focal_px, (v[row, column] - K.cy_px) / K.focal_px
        square = x * x + y * y
        stretch = 1 - 0.08 * square + 0.01 * square**2
        assert x * stretch * K.focal_px + K.cx_px == pytest.approx(column, abs=0.01)
        assert y * stretch * K.focal_px + K.cy_px == pytest.approx(row, abs=0.01)
    assert lens.reach_px(K) >= np.abs(middle(u - ramps()[0], 0.9)).max()


def test_a_part_of_the_picture_is_shifted_as_it_is_in_the_whole():
    lens = Misalignment(k1=0.05, rows_px=0.5, columns_px=0.5, cell_px=40.0)
    part = Window(60, 50, 90, 70)
    for ramp in ramps():
        whole = lens.seen(ramp, WHOLE, K, right=True)[50:120, 60:150]
        alone = lens.seen(np.ascontiguousarray(ramp[50:120, 60:150]), part, K, right=True)
        np.testing.assert_allclose(middle(whole), middle(alone), atol=0.02)


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
    moved = lens.seen(ramp, across, sensor.intrinsics, right=True)[1, 540] - 540
    assert abs(moved) > 0.3
    # Where the right picture shows what lies farther right, its disparity is larger.
    assert error[1] - error[0] == pytest.approx(moved, abs=0.1)
