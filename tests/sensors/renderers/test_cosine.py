"""Cosine of incidence: `Image.cosine` of every renderer against planes, a sphere and each other."""

import numpy as np
import pytest
import trimesh

from qs3.geometry.cameras import Camera, Intrinsics
from qs3.meshes.mesh import Mesh
from qs3.sensors.renderers.base import Body, Scene
from tests.sensors.renderers.scenes import quad, tilted_pose


def seen(renderer, bodies, camera):
    (image,) = renderer.render(Scene(bodies, None, 1.0), [camera], seed=0, geometry=[True])
    return image


def rays(camera):
    """[h, w, 3] unit directions through the pixels' centres, camera axes."""
    window, k = camera.rendered, camera.intrinsics
    u, v = np.meshgrid(window.left + np.arange(window.width), window.top + np.arange(window.height))
    x, y = (u - k.cx_px) / k.focal_px, (v - k.cy_px) / k.focal_px
    direction = np.stack([x, y, np.ones_like(x)], axis=-1)
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


@pytest.mark.parametrize("angle_deg", [0, 60])
@pytest.mark.parametrize("flip", [False, True], ids=["front", "back"])
def test_plane_at_an_angle(renderer, angle_deg, flip):
    # Turned about the camera's y axis; the camera itself is turned and shifted in the world.
    pose, tan = tilted_pose(), np.tan(np.deg2rad(angle_deg))
    plane = quad([[-1, -9, 2 - tan], [1, -9, 2 + tan], [1, 9, 2 + tan], [-1, 9, 2 - tan]])
    faces = plane.mesh.faces[:, ::-1] if flip else plane.mesh.faces
    body = Body(Mesh(plane.mesh.vertices, faces).transformed(pose))
    camera = Camera(Intrinsics(48, 40, 300.0, 21.3, 17.8), pose)
    image = seen(renderer, (body,), camera)
    normal = np.array([-np.sin(np.deg2rad(angle_deg)), 0, np.cos(np.deg2rad(angle_deg))])
    expected = np.abs(rays(camera) @ normal)
    assert np.isfinite(image.depth_m).all()
    np.testing.assert_allclose(image.cosine, expected, atol=2e-6)
    assert image.cosine.dtype == np.float32
    # and where the optical axis meets the plane it is the cosine of the angle itself
    assert image.cosine[18, 21] == pytest.approx(np.cos(np.deg2rad(angle_deg)), abs=3e-3)


def test_sphere_and_nothing_around_it(renderer):
    radius, centre = 0.5, np.array([0.1, -0.05, 2.0])
    solid = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    body = Body(Mesh(np.asarray(solid.vertices) + centre, np.asarray(solid.faces)))
    camera = Camera(Intrinsics.centred(90, 80, 120.0), np.eye(4))
    image = seen(renderer, (body,), camera)
    direction = rays(camera)
    # the angle at a sphere by the law of sines: sin(incidence) = distance of the ray / radius
    off = np.linalg.norm(np.cross(direction, centre), axis=-1) / radius
    expected = np.sqrt(np.clip(1 - off**2, 0, None))
    inner = off < 0.98
    assert np.abs(image.cosine - expected)[inner].max() < 0.06  # flat faces, 2 degrees wide
    assert np.abs(image.cosine - expected)[inner].mean() < 0.01
    assert (image.cosine[off > 1.01] == 0).all()
    assert (image.cosine[inner] > 0).all()
