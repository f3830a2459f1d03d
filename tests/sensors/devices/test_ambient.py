"""Ambient light that competes with the dots: laser speckle is the projector's alone."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.sensors.devices.fringe import FringeProjection
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.optics.infrared import InfraredCamera
from tests.sensors.scenery import box_of, plane, scan, square

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


@pytest.mark.parametrize("kind", [ReferenceSpeckle, FringeProjection])
def test_sensors_with_one_camera_go_by_the_image_unless_told_otherwise(kind, renderer):
    thing = replace(square(2.0, 0.1, albedo=0.08), label=1)
    wall = replace(square(2.5, 0.5, albedo=0.8), label=0)
    grey = {}
    for metering in ("object", "image", None):
        camera = InfraredCamera(read_noise_e=0.0, electrons_at_white=1e9, metering=metering)
        frame = scan(kind(infrared=camera), [thing, wall], renderer, box=box_of(thing))
        grey[metering] = frame.images["left"][np.abs(frame.images["clean"] - 2.0) < 0.01].mean()
    assert grey["object"] > 3 * grey["image"]
    assert grey[None] == grey["image"]
