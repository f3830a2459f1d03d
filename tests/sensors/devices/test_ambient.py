"""Ambient light that competes with the dots: laser speckle is the projector's alone."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.errors import ConfigError
from qs3.sensors.devices.fringe import FringeProjection
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.matching import CensusMatcher
from qs3.sensors.optics.infrared import InfraredCamera
from tests.sensors.scenery import box_of, middle, plane, scan, square

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


def test_with_sunlight_speckle_on_the_projectors_light_only_costs_nothing(renderer):
    """Ambient light 20 times a dot at 4 m; with speckle on all light the plane is lost in it."""
    sensor = SpeckleStereo(ambient=20.0, matcher=CensusMatcher(num_disparities=160))
    fill, rms = [], []
    for contrast, speckles in ((0.0, True), (0.2, False), (0.2, True)):
        camera = InfraredCamera(
            speckle_contrast=contrast, psf_px=0.4, read_noise_e=10.0, ambient_speckles=speckles
        )
        frame = scan(replace(sensor, infrared=camera), [plane(2.0, 0.15, tilt_deg=20)], renderer)
        inside = middle(frame.label == 1)
        lens = sensor.focal_px * sensor.baseline_m
        off = middle(lens / frame.depth_m - lens / frame.clean_m)[inside]
        fill.append(np.isfinite(off).mean())
        rms.append(np.sqrt(np.nanmean(off**2)))
    without, split, whole = range(3)
    assert fill[split] > fill[without] - 0.02, (fill, rms)
    assert rms[split] < 1.5 * rms[without] + 0.02, (fill, rms)
    assert fill[whole] < fill[without] - 0.1 or rms[whole] > 10 * rms[without], (fill, rms)


def test_a_bright_wall_darkens_the_object_where_the_whole_image_is_metered(renderer):
    thing = replace(square(2.0, 0.1, albedo=0.08), label=1)
    wall = replace(square(2.5, 0.5, albedo=0.8), label=0)
    quiet = InfraredCamera(read_noise_e=0.0, electrons_at_white=1e9, white_quantile=1.0)
    grey = {}
    for metering in ("object", "image", None):
        sensor = SpeckleStereo(infrared=replace(quiet, metering=metering))
        frame = scan(sensor, [thing, wall], renderer, box=box_of(thing))
        clean = frame.images["clean"]
        grey[metering] = frame.images["left"][np.abs(clean - 2.0) < 0.01].mean()
    # What is as bright as can be: ambient light and a dot on the wall, over the same on the object.
    brighter = 0.8 * (0.15 + 16 / 2.5**2) / (0.08 * (0.15 + 16 / 2.0**2))
    assert grey["object"] / grey["image"] == pytest.approx(brighter, rel=0.1)
    assert grey[None] == grey["object"]


def test_fringes_refuse_it():
    with pytest.raises(ConfigError, match=r"sensor\.infrared\.ambient_speckles=false"):
        FringeProjection(infrared=replace(SPECKLED, ambient_speckles=False))


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
