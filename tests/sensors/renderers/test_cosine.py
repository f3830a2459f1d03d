"""Cosine of incidence: `Image.cosine` of every renderer on planes."""

import numpy as np
import pytest

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
