"""Fringe projection obeys its own law, unwraps rightly, and has a projector's shadows."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.geometry.cameras import Camera, Intrinsics, Window
from qs3.sensors.devices.fringe import FringeCode, FringeProjection
from qs3.sensors.optics.visibility import Reason, sample_centres
from qs3.sensors.renderers.base import Projector, Scene
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.scenery import POSE, middle, scan, square

SIDE = FringeProjection()


def law_of(camera, frame, depth):
    """The law's sigma for each pixel in the middle of a frame, from what it recorded."""
    finest = middle(frame.images["exposures"][-camera.code.steps :].astype(float))
    per_grey = camera.infrared.electrons_at_white / 255
    electrons = finest.mean(axis=0) * per_grey + camera.infrared.read_noise_e**2
    noise = np.sqrt(electrons / per_grey**2 + 1 / 12)  # shot, read-out, rounding
    phase = np.sqrt(2 / camera.code.steps) * noise / middle(frame.images["modulation"])
    place = phase / (2 * np.pi * camera.code.periods[-1])
    return depth**2 / camera.baseline_m * 2 * camera.tan_half_width * place


@pytest.mark.parametrize("white_level", [pytest.param(70.0, marks=pytest.mark.slow), 220.0])
def test_noise_and_bias_follow_the_stated_law(renderer, white_level):
    camera = replace(SIDE, infrared=replace(SIDE.infrared, white_level=white_level))
    measured = []
    for depth in (0.8, 1.5, 2.5):
        frame = scan(camera, [square(depth, 0.1 * depth)], renderer, seed=int(10 * depth))
        law, error = law_of(camera, frame, depth), middle(frame.depth_m) - depth
        assert np.isfinite(error).all()
        assert (error / law).std() == pytest.approx(1, abs=0.05)
        assert abs(error.mean()) < 5 * law.mean() / np.sqrt(error.size) + 2e-5
        measured.append(error.std())
    # The square of the distance and a little: ambient light takes its share of the exposure.
    assert np.log(measured[2] / measured[0]) / np.log(2.5 / 0.8) == pytest.approx(2.1, abs=0.2)


@pytest.mark.parametrize(
    "make", [MitsubaRenderer, pytest.param(BlenderRenderer, marks=pytest.mark.blender)]
)
def test_where_a_renderer_looks_does_not_depend_on_the_scene(make):
    """The twin: another plane, further away and larger, and another slide on it."""
    camera = Camera(Intrinsics.centred(64, 48, 60.0), POSE, Window(20, 10, 16, 12))
    renderer = make(samples=16)
    found = sample_centres(camera, renderer, 5)
    depth, half, albedo = 2.3, 0.9, 0.6
    fall = ((np.arange(500) + 0.5) / 500)[::-1].astype(np.float32)  # 1 to 0
    slide = np.ascontiguousarray(np.broadcast_to(fall, (500, 500)))
    scene = Scene((square(depth, 3.0, albedo),), Projector(POSE, slide, half))
    (image,) = renderer.render(scene, [camera], seed=5, geometry=[False])
    tangent = half * (1 - 2 * image.radiance.astype(float) * depth**2 / albedo)
    expected = tangent * camera.intrinsics.focal_px + camera.intrinsics.cx_px
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert 0.005 < (found - np.arange(20, 36)).std() < 0.1  # not the centres


@settings(deadline=None, max_examples=50)
@given(
    st.sampled_from([(1.0,), (1.0, 8.0), (0.5, 3.0, 20.0), (1.0, 7.0, 50.0)]),
    st.integers(3, 9),
    st.lists(st.floats(0.001, 0.999), min_size=1, max_size=5),
    st.floats(1, 100),
    st.floats(0, 100),
)
def test_decoding_undoes_the_slides(periods, steps, places, modulation, ambient):
    code = FringeCode(periods, steps)
    s = np.array(places)[None]
    angle = 2 * np.pi * np.array(periods)[:, None, None, None] * s
    step = 2 * np.pi / steps * np.arange(steps)[:, None, None]
    exposures = ambient + modulation * (1 + np.cos(angle + step))
    found, strength, misfit = code.decode(exposures)
    np.testing.assert_allclose(found, s, atol=1e-9)
    np.testing.assert_allclose(strength, modulation, rtol=1e-9)
    assert misfit.max() < 1e-6


def test_slides_are_what_decoding_expects():
    code = FringeCode((1.0, 4.0), steps=4, columns=64, rows=48)
    slides = code.slides
    assert slides.shape == (2, 4, 48, 64)
    assert slides.dtype == np.float32
    place, _, _ = code.decode(slides.astype(float))
    expected = np.broadcast_to((np.arange(64) + 0.5) / 64, place.shape)
    np.testing.assert_allclose(place, expected, atol=1e-6)


@pytest.mark.slow
def test_reasons(renderer):
    def reasons(camera, body):
        frame = scan(camera, [body], renderer)
        np.testing.assert_array_equal(np.isfinite(frame.depth_m), frame.reason == Reason.OK)
        return frame

    frame = reasons(SIDE, square(1.5))
    empty = ~np.isfinite(frame.clean_m)
    assert (frame.reason[empty & ~np.isfinite(frame.depth_m)] == Reason.EMPTY).all()
    loud = replace(SIDE, infrared=replace(SIDE.infrared, white_level=255.0, white_quantile=0.1))
    assert (middle(reasons(loud, square(1.5)).reason) == Reason.SATURATED).mean() > 0.5
    assert (middle(reasons(SIDE, square(7.0)).reason) == Reason.RANGE).mean() > 0.99
    narrow = replace(SIDE, tan_half_width=0.1)
    aside = reasons(narrow, square(1.0, 0.4))
    assert (aside.reason == Reason.OUTSIDE).mean() > 0.4
    bright = replace(SIDE, ambient=20.0)  # the pattern drowns
    assert (middle(reasons(bright, square(1.5)).reason) == Reason.DARK).all()
