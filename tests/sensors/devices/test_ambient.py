"""Ambient light that competes with the dots: laser speckle is the projector's alone."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.errors import ConfigError
from qs3.sensors.devices.fringe import FringeProjection
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.optics.infrared import InfraredCamera
from tests.sensors.scenery import plane, scan

SPECKLED = InfraredCamera(speckle_contrast=0.2, psf_px=0.4)


@pytest.mark.parametrize("kind", [SpeckleStereo, ReferenceSpeckle])
def test_without_speckle_of_its_own_ambient_light_costs_less(kind, renderer):
    """Light from all sides as bright as the dots, on a plane."""
    good, error = [], []
    for speckles in (True, False):
        sensor = kind(ambient=1.0, infrared=replace(SPECKLED, ambient_speckles=speckles))
        frame = scan(sensor, [plane(2.0, 0.15, tilt_deg=20)], renderer)
        off = np.abs(frame.depth_m - frame.clean_m)[frame.label == 1]
        good.append(np.mean(off < 0.02))  # NaN is not
        error.append(np.nanmean(off))
    assert good[1] >= good[0]
    assert error[1] < 0.8 * error[0] or good[1] > 1.2 * good[0]
    assert good[1] > 0.6, (good, error)


def test_fringes_refuse_it():
    with pytest.raises(ConfigError, match=r"sensor\.infrared\.ambient_speckles=false"):
        FringeProjection(infrared=replace(SPECKLED, ambient_speckles=False))
