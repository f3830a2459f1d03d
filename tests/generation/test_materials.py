"""What bodies are made of, and in which light they stand."""

import numpy as np
import pytest
import trimesh

import qs3
from qs3.generation.materials import LightAbove
from qs3.geometry.cameras import Camera, Intrinsics, look_at
from qs3.meshes.mesh import Mesh, merge
from qs3.sensors.renderers.base import Body, Scene
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.generation.generating import QUICK
from tests.meshes.written import as_trimesh

LIT = ("materials=principled", "light=area")


def block(size, at=(0.0, 0.0, 0.0), turn=0.0):
    solid = trimesh.creation.box(size)
    solid.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
    return Mesh(np.asarray(solid.vertices) + np.array(at), solid.faces)


def stool():
    """A seat on four legs, which do not touch it."""
    legs = [
        block((0.05, 0.04, 0.4), (x, y, 0.2), 0.3 * x) for x in (-0.2, 0.2) for y in (-0.2, 0.2)
    ]
    return merge([block((0.5, 0.5, 0.04), (0, 0, 0.43)), *legs])


@pytest.mark.parametrize("side", [0.5, 3.0, 24.0])
def test_white_under_the_light_has_its_strength(side):
    box = np.array([[-0.3, 0.1, 0.0], [0.5, 0.7, 0.8]])
    lighting = LightAbove(height_m=1.2, side_m=side, strength=0.3, ambient=0.02).over(box)
    assert lighting.ambient == 0.02
    # A white table top at the object's highest point, seen from above beside the light's axis.
    top = block((0.2, 0.2, 0.1), (0.1, 0.4, 0.75))
    pose = look_at(np.array([0.1, 0.2, 1.8]), np.array([0.1, 0.4, 0.8]))
    camera = Camera(Intrinsics.centred(5, 5, 300.0), pose)
    (image,) = MitsubaRenderer(samples=256).render(
        Scene((Body(top, albedo=1.0),), area=lighting.area), [camera], seed=0, geometry=[True]
    )
    np.testing.assert_allclose(image.radiance, 0.3, rtol=0.02)


def test_an_object_s_bytes_depend_on_its_id_and_not_on_the_others():
    words = ("domain=specklenet10", *QUICK, "views=1", *LIT)
    both = qs3.generate({"a": as_trimesh(stool()), "b": as_trimesh(stool())}, *words)
    alone = qs3.generate({"b": as_trimesh(stool())}, *words)["b"]
    np.testing.assert_array_equal(alone.points, both["b"].points)
    np.testing.assert_array_equal(
        alone.frames[0].images["left"], both["b"].frames[0].images["left"]
    )
    matt = qs3.generate({"b": as_trimesh(stool())}, *words[:-2])["b"]
    np.testing.assert_array_equal(matt.clean, alone.clean)  # it stands where it stood
    assert (matt.frames[0].images["left"] != alone.frames[0].images["left"]).mean() > 0.05
