"""Surfaces that shine and the area light, against their formulas."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import RenderError
from qs3.geometry.cameras import Camera, Intrinsics, Window
from qs3.sensors.renderers.base import AreaLight, Projector, RendererSettings, Scene, tangents
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.gloss import COSINES, Gloss, fresnel, kept_back
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.renderers.scenes import moved, octahedron, quad, wall

UP = np.array([0.0, 0.0, 1.0])
GLOSSES = [Gloss(0.5, 0.5), Gloss(0.25, 1.0), Gloss(0.9, 0.3)]
WHITE = np.ones((8, 8), dtype=np.float32)


@pytest.fixture(scope="module")
def mitsuba():
    renderer = MitsubaRenderer(samples=16)
    if renderer.variant.startswith("scalar_"):
        pytest.skip("no compiled variant works here")
    return renderer


def times_pi(albedo, gloss, normal, i, o, mirrors=False):
    """[...] pi f(i, o) by the formula of `gloss`; unit vectors [..., 3]. Mirrors: F = 1, M = 1."""
    cos_i, cos_o = (np.maximum((normal * way).sum(-1), 1e-9) for way in (i, o))
    half = unit(i + o)
    square = gloss.alpha**2
    facets = square / ((normal * half).sum(-1) ** 2 * (square - 1) + 1) ** 2
    # 4 cos_i cos_o is in the masking's denominator already.
    seen = 0.5 / (
        cos_i * np.sqrt(square + (1 - square) * cos_o**2)
        + cos_o * np.sqrt(square + (1 - square) * cos_i**2)
    )
    if mirrors:
        return facets * seen
    met = (o * half).sum(-1)
    kept = np.interp(cos_o, np.linspace(0, 1, COSINES), kept_back(gloss))
    return albedo * (1 - kept) + facets * seen * fresnel(gloss, met)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def sky(count=160):
    """Directions whose mean is the integral over the hemisphere of f cos / pi, evenly placed."""
    a, b = (x.ravel() for x in np.meshgrid(*[(np.arange(count) + 0.5) / count] * 2))
    sine, turn = np.sqrt(a), 2 * np.pi * b
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), np.sqrt(1 - a)], axis=-1)


def eye(cosine):
    return np.array([np.sqrt(1 - cosine**2), 0.0, cosine])


def reflected(albedo, gloss, cosine, mirrors=False):
    """Share of even light from all sides that is sent to the eye."""
    way = sky()
    to_eye = np.broadcast_to(eye(cosine), way.shape)
    return times_pi(albedo, gloss, UP, way, to_eye, mirrors).mean()


# --- the formula


@pytest.mark.parametrize("roughness", [0.3, 0.5, 1.0])
@pytest.mark.parametrize("cosine", [0.25, 0.75, 1.0])
def test_kept_back_is_the_mean_reflectance_of_the_facets(roughness, cosine):
    """What a black surface reflects of a white sky, over what facets that are mirrors do."""
    mirrors = reflected(1.0, Gloss(roughness), cosine, mirrors=True)
    found = np.interp(cosine, np.linspace(0, 1, COSINES), kept_back(Gloss(roughness, 0.5)))
    assert found == pytest.approx(reflected(0.0, Gloss(roughness), cosine) / mirrors, rel=0.02)


@settings(max_examples=12, deadline=None)
@given(
    albedo=st.floats(0, 1),
    roughness=st.floats(0.2, 1),
    specular=st.floats(0, 1),
    cosine=st.floats(0.1, 1),
)
def test_nothing_reflects_more_than_it_gets(albedo, roughness, specular, cosine):
    assert 0 <= reflected(albedo, Gloss(roughness, specular), cosine) <= 1.005


# --- Mitsuba's kernel


def tilted_plane(gloss, albedo=0.4):
    """A plane seen at a slant, lit from the side; what its formula says of each pixel."""
    body = replace(
        quad([[-2, -2, 1.6], [2, -2, 2.4], [2, 2, 2.4], [-2, 2, 1.6]], albedo), gloss=gloss
    )
    camera = Camera(Intrinsics.centred(41, 31, 30.0), np.eye(4))
    x, y = tangents(camera)
    z = 2 / (1 - 0.2 * x) + 0 * y
    points = np.stack([x * z, y * z, z], axis=-1)
    normal = np.array([0.2, 0, -1]) / np.hypot(0.2, 1)
    return body, camera, points, normal


@pytest.mark.parametrize("gloss", GLOSSES)
def test_a_plane_under_the_projector_shines_as_the_formula_says(gloss, mitsuba):
    body, camera, points, normal = tilted_plane(gloss)
    lamp = np.array([-0.6, 0, 0])
    scene = Scene((body,), Projector(moved(-0.6), WHITE, 1.6, strength=2.0), ambient=0.1)
    (image,) = mitsuba.render(scene, [camera], seed=0, geometry=[False])
    way = unit(lamp - points)
    # `Projector.strength`: cosine of incidence over that to the axis, and Z squared
    light = 2 * (way @ normal) * np.linalg.norm(points - lamp, axis=-1) / points[..., 2] ** 3
    expected = 0.04 + times_pi(0.4, gloss, normal, way, unit(-points)) * light
    error = np.abs(image.radiance / expected - 1)[1:-1, 1:-1]
    assert np.median(error) < 0.002
    assert np.quantile(error, 0.99) < 0.1  # a pixel is not a point: where the reflex is steep
    assert expected.max() > 1.5 * np.median(expected) or gloss.roughness > 0.5


def above(camera_down_m, depth_m):
    """A light above the camera's axis that looks down (the camera's y)."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T
    pose[:3, 3] = 0, camera_down_m, depth_m
    return pose


@pytest.mark.parametrize("gloss", [None, Gloss(0.6, 1.0), Gloss(0.3)])
@pytest.mark.parametrize("side", [0.5, 4.0])
def test_an_area_light_is_the_sum_of_its_points(gloss, side, mitsuba):
    """A slow twin: 120 x 120 lamps on the square, each by the inverse square and two cosines."""
    body, camera, points, normal = tilted_plane(gloss)
    pose = above(-1.0, 1.2)
    mitsuba.settings = RendererSettings(samples=8192)
    scene = Scene((body,), area=AreaLight(pose, side, radiance=0.7))
    offsets = ((np.arange(120) + 0.5) / 120 - 0.5) * side
    lamps = (
        pose[:3, 3] + np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2) @ pose[:3, :2].T
    )
    for row, col in ((8, 12), (15, 20), (27, 33)):
        to = lamps - points[row, col]
        distance = np.linalg.norm(to, axis=-1)
        way = to / distance[:, None]
        lit = np.maximum(way @ normal, 0) * np.maximum(-way @ pose[:3, 2], 0) / distance**2
        if gloss is None:
            factor = 0.4
        else:
            eye_way = np.broadcast_to(unit(-points[row, col]), way.shape)
            above_it = way @ normal > 0
            factor = np.where(above_it, times_pi(0.4, gloss, normal, way, eye_way), 0)
        expected = 0.7 * (factor * lit).sum() / np.pi * (side / 120) ** 2
        pixel = replace(camera, window=Window(col, row, 1, 1))
        (image,) = mitsuba.render(scene, [pixel], seed=0, geometry=[False])
        assert image.radiance[0, 0] == pytest.approx(expected, rel=0.015)


def test_the_variant_without_a_compiler_refuses_what_it_cannot_render():
    renderer = MitsubaRenderer(variant="scalar_rgb")
    camera = Camera(Intrinsics.centred(8, 8, 8.0), np.eye(4))
    shiny = Scene((replace(wall(1.0), gloss=GLOSSES[0]),))
    for scene in (shiny, Scene((wall(1.0),), area=AreaLight(np.eye(4), 1.0, 1.0))):
        with pytest.raises(RenderError):
            renderer.render(scene, [camera], seed=0, geometry=[False])


# --- Blender


@pytest.mark.slow
@pytest.mark.blender
@pytest.mark.parametrize("gloss", [None, *GLOSSES])
def test_blender_s_principled_bsdf_is_the_same_surface(gloss, mitsuba):
    """Another implementation of the same model: radiance of a plane and of a body with corners."""
    body, camera, _, _ = tilted_plane(gloss)
    ball = replace(quad([[0, 0, 1]] * 4), mesh=octahedron((0.05, 0.02, 1.0), 0.3), gloss=gloss)
    projector = Projector(moved(-0.6), WHITE, 1.6, strength=2.0)
    light = AreaLight(above(-1.0, 1.2), 1.5, radiance=1.0)
    mitsuba.settings = RendererSettings(samples=64)
    blender = BlenderRenderer(samples=64)
    for scene, typical, worst in (
        (Scene((body,), projector, 0.1), 0.001, 0.06),
        (Scene((body, ball), projector, 0.1, light), 0.005, 0.1),
    ):
        (a,), (b,) = (
            r.render(scene, [camera], seed=0, geometry=[False]) for r in (mitsuba, blender)
        )
        error = np.abs(b.radiance / a.radiance - 1)[1:-1, 1:-1]
        assert np.median(error) < typical
        assert np.quantile(error, 0.95) < worst
        assert b.radiance.mean() == pytest.approx(a.radiance.mean(), rel=0.005)
