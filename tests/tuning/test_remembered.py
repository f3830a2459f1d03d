"""What is remembered is what the renderer gives."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.geometry.cameras import Camera, Intrinsics, Window
from qs3.sensors.optics.patterns import Speckle
from qs3.sensors.renderers.base import Projector, Scene
from qs3.sensors.renderers.gloss import Gloss
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from qs3.tuning.remembered import Remembered
from tests.sensors.scenery import POSE, square

K = Intrinsics(120, 90, 100.0, 59.5, 44.5)
CAMERAS = [Camera(K, POSE), Camera(K, POSE, Window(10, 5, 60, 40))]
BODY = square(1.0, 0.3, albedo=0.7)
LIT = Scene((BODY,), Projector(POSE, Speckle(columns=100, rows=80).slide, 0.6, 2.0), 0.15)


class Counted:
    """Says how often the renderer behind it was asked."""

    def __init__(self, behind):
        self.behind, self.calls = behind, 0

    def render(self, *args, **more):
        self.calls += 1
        return self.behind.render(*args, **more)

    def provenance(self):
        return self.behind.provenance()


@pytest.fixture
def counted():
    return Counted(MitsubaRenderer(samples=4))


def ask(what, scene, cameras=CAMERAS, seed=3, geometry=(True, False)):
    return what.render(scene, cameras, seed=seed, geometry=list(geometry))


@pytest.mark.parametrize("projector", [LIT.projector, None])
def test_a_remembered_image_is_the_rendered_one_in_any_ambient_light(counted, projector):
    known = Remembered(counted)
    for strength in (0.15, 0.0, 3.0):
        scene = replace(LIT, projector=projector, ambient=strength)
        for ours, true in zip(ask(known, scene), ask(counted.behind, scene), strict=True):
            np.testing.assert_allclose(ours.radiance, true.radiance, rtol=3e-7, atol=1e-7)
            for name in ("depth_m", "label", "cosine"):
                np.testing.assert_array_equal(getattr(ours, name), getattr(true, name))
    assert counted.calls == (2 if projector else 1)
    assert known.provenance() == counted.behind.provenance()


def test_images_are_the_caller_s_own(counted):
    known = Remembered(counted)
    for name in ("radiance", "depth_m", "label", "cosine"):
        getattr(ask(known, LIT)[0], name)[...] = 7
        assert (getattr(ask(known, LIT)[0], name) != 7).any()


def test_whatever_decides_an_image_is_rendered_anew(counted):
    known = Remembered(counted)
    ask(known, LIT)
    other = replace(BODY, mesh=replace(BODY.mesh, vertices=BODY.mesh.vertices * 1.01))
    asked = [
        {"scene": replace(LIT, bodies=(other,))},
        {"scene": replace(LIT, bodies=(replace(BODY, albedo=0.6),))},
        {"scene": replace(LIT, projector=replace(LIT.projector, strength=1.0))},
        {"scene": replace(LIT, projector=replace(LIT.projector, slide=LIT.projector.slide.T))},
        {"scene": LIT, "cameras": CAMERAS[::-1]},
        {"scene": LIT, "seed": 4},
        {"scene": LIT, "geometry": (True, True)},
    ]
    for i, more in enumerate(asked):
        for ours, true in zip(ask(known, **more), ask(counted.behind, **more), strict=True):
            np.testing.assert_allclose(ours.radiance, true.radiance, rtol=3e-7, atol=1e-7)
            np.testing.assert_array_equal(ours.depth_m, true.depth_m)
        assert counted.calls == 2 * (i + 2)


def test_the_oldest_go_when_there_are_too_many(counted):
    one = 2 * sum(c.rendered.width * c.rendered.height for c in CAMERAS) * (4 + 4 + 1 + 4)
    known = Remembered(counted, most_bytes=2 * one)
    for seed in (0, 1, 0, 2):  # 1 is the oldest then
        ask(known, LIT, seed=seed)
    assert counted.calls == 6
    ask(known, LIT, seed=0)
    assert counted.calls == 6
    ask(known, LIT, seed=1)
    assert counted.calls == 8


def test_what_shines_is_left_to_the_renderer(counted):
    shiny = replace(LIT, bodies=(replace(BODY, gloss=Gloss(0.3, 0.5)),))
    known = Remembered(counted)
    for _ in range(2):
        ours, true = ask(known, shiny)[0], ask(counted.behind, shiny)[0]
        np.testing.assert_array_equal(ours.radiance, true.radiance)
    assert counted.calls == 2
