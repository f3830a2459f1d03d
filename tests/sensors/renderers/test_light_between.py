"""Light that surfaces give each other, and light that passes through them: both renderers."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.geometry.cameras import Camera, Intrinsics
from qs3.sensors.renderers.base import AreaLight, Body, Projector, Scene
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.gloss import Gloss
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.renderers.scenes import dots, moved, quad, wall

WHITE = np.ones((64, 64), np.float32)
CAMERA = Camera(Intrinsics(120, 100, 110.0, 59.5, 49.5), moved(0.0))
BACK_M, SIDE_M = 1.5, 0.3


@pytest.fixture(scope="module")
def mitsuba():
    renderer = MitsubaRenderer(samples=256)
    if renderer.variant.startswith("scalar_"):
        pytest.skip("no compiled variant works here")
    return renderer


@pytest.fixture(scope="module")
def blender():
    return BlenderRenderer(samples=64)


def projector(slide=WHITE):
    return Projector(moved(0.05), slide, tan_half_width=0.8, strength=1.0)


def corner(albedo=0.8, **more):
    """A wall, and one at right angles to it on the right."""
    side = [[SIDE_M, -1, 0.5], [SIDE_M, 1, 0.5], [SIDE_M, 1, BACK_M], [SIDE_M, -1, BACK_M]]
    bodies = (wall(BACK_M, 1.0, albedo), quad(side, albedo, 2))
    return Scene(bodies, projector(more.pop("slide", WHITE)), ambient=0.05, **more)


def indirect(renderer, scene):
    """What the bounce adds."""
    direct, both = (
        renderer.render(replace(scene, bounces=n), [CAMERA], seed=1, geometry=[True])[0]
        for n in (0, 1)
    )
    np.testing.assert_array_equal(direct.depth_m, both.depth_m)
    return both.radiance - direct.radiance


def by_quadrature(column, row, albedo):
    """What the wall behind gets from the one at the side, over small squares of it."""
    k = CAMERA.intrinsics
    x = (column - k.cx_px) / k.focal_px * BACK_M
    y = (row - k.cy_px) / k.focal_px * BACK_M
    step = 0.005
    v = np.arange(-1 + step / 2, 1, step)[:, None]
    z = np.arange(0.5 + step / 2, BACK_M, step)
    # The projector at (0.05, 0, 0): radiance of the side, whose cosine is (0.3 - 0.05) / distance.
    across = (SIDE_M - 0.05) / z
    lit = (across <= 0.8) & (np.abs(v / z) <= 0.8)
    radiance = np.where(lit, albedo * (SIDE_M - 0.05) / z**3, 0)
    dx, dy, dz = SIDE_M - x, v - y, z - BACK_M
    square = dx**2 + dy**2 + dz**2
    # cosine at the wall behind: -dz / d; at the side: dx / d.
    return albedo / np.pi * (radiance * -dz * dx / square**2).sum() * step**2


def test_a_wall_gets_the_light_of_another_as_an_integral_says(mitsuba):
    added = indirect(mitsuba, corner())
    for column, row in ((20, 50), (50, 50), (70, 40), (70, 70)):
        around = added[row - 5 : row + 6, column - 5 : column + 6].mean()
        assert around == pytest.approx(by_quadrature(column, row, 0.8), rel=0.05)


# Blender's dots light in spots, which leaves it noise; ours have the slide's mean.
@pytest.mark.parametrize(
    ("slide", "alike"),
    [
        pytest.param(WHITE, 0.99, id="white", marks=pytest.mark.slow),
        pytest.param(dots(90, seed=3), 0.96, id="dots"),
    ],
)
def test_both_renderers_add_the_same_light(mitsuba, blender, slide, alike):
    ours, theirs = (indirect(renderer, corner(slide=slide)) for renderer in (mitsuba, blender))
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.03)
    blocks = [a.reshape(10, 10, 12, 10).mean(axis=(1, 3)) for a in (ours, theirs)]
    assert np.corrcoef(*(block.ravel() for block in blocks))[0, 1] > alike


def sheet(transmission, albedo=0.3, depth_m=1.0, half_m=0.2, label=3, specular=0.0):
    h = half_m
    body = quad([[-h, -h, depth_m], [h, -h, depth_m], [h, h, depth_m], [-h, h, depth_m]], albedo)
    return Body(body.mesh, albedo, label, Gloss(1.0, specular, transmission=transmission))


def middle_of(image):
    """Where the sheet is, and where camera and projector see the wall through it."""
    return image[45:56, 55:66]


def test_through_a_clear_sheet_the_wall_is_seen_in_light_that_came_through(mitsuba, blender):
    """A matt sheet: t (wall's ambient + t projected) + (1 - t) (sheet's own)."""
    t, ambient, albedo = 0.7, 0.05, 0.8
    scene = Scene((wall(BACK_M, 1.0, albedo), sheet(t)), projector(), ambient)
    own = 0.3 * (ambient + 1.0)
    behind = albedo * (ambient + t / BACK_M**2)
    for renderer in (mitsuba, blender):
        (image,) = renderer.render(scene, [CAMERA], seed=0, geometry=[True])
        expected = t * behind + (1 - t) * own
        assert middle_of(image.radiance).mean() == pytest.approx(expected, rel=0.02)
        assert (middle_of(image.label) == 3).all()  # the truth is the sheet's
        np.testing.assert_allclose(middle_of(image.depth_m), 1.0, rtol=1e-5)
        assert image.radiance[50, 5] == pytest.approx(albedo * (ambient + 1 / BACK_M**2), rel=0.01)


@pytest.mark.slow
def test_the_area_light_passes_through_a_sheet(mitsuba, blender):
    pose = moved(0.0)
    area = AreaLight(pose, side_m=0.02, radiance=50.0)  # before the camera's middle
    lit = Scene((wall(BACK_M, 1.0, 0.8),), area=area)
    black = replace(lit, bodies=(*lit.bodies, sheet(0.5, 0.0)))
    for renderer in (mitsuba, blender):
        plain, dimmed = (
            renderer.render(scene, [CAMERA], seed=0, geometry=[True])[0].radiance
            for scene in (lit, black)
        )
        share = middle_of(dimmed).mean() / middle_of(plain).mean()
        assert share == pytest.approx(0.25, rel=0.05)


@pytest.mark.slow
def test_a_shiny_clear_sheet_is_the_same_in_both(mitsuba, blender):
    shiny = sheet(0.8, 0.1, specular=0.5)
    shiny = replace(shiny, gloss=replace(shiny.gloss, roughness=0.3))
    scene = Scene((wall(BACK_M, 1.0, 0.8), shiny), projector(dots(90, seed=3)), ambient=0.1)
    ours, theirs = (
        renderer.render(scene, [CAMERA], seed=0, geometry=[True])[0].radiance
        for renderer in (mitsuba, blender)
    )
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.01)
    assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.98
