"""What bodies are made of, and in which light they stand."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

import qs3
from qs3.config.hydra import build
from qs3.config.location import CONF
from qs3.generation.materials import Kind, LightAbove, MixedMaterials, parts_of
from qs3.geometry.cameras import Camera, Intrinsics, look_at
from qs3.meshes.mesh import Mesh, merge
from qs3.sensors.renderers.base import Body, Scene
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.generation.generating import QUICK

LIT = ("materials=mixed", "light=area")


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


def node(group, name, *words):
    """What a file of conf says, with some values changed."""
    found = OmegaConf.load(CONF / group / f"{name}.yaml")[group]
    return OmegaConf.merge(found, OmegaConf.from_dotlist(list(words)))


MIXED = node("materials", "mixed")


# --- parts


def test_a_stool_has_a_seat_and_legs():
    parts = parts_of(stool())
    assert len(parts) == 60
    assert set(parts[:12]) == {0}
    assert set(parts[12:]) == {1}


def test_parts_hang_together_by_place_and_not_by_index():
    """A soup of triangles, as CAD files often are; the order of faces does not matter."""
    mesh = stool()
    soup = Mesh(mesh.vertices[mesh.faces.ravel()], np.arange(3 * len(mesh.faces)).reshape(-1, 3))
    np.testing.assert_array_equal(parts_of(soup), parts_of(mesh))
    order = np.random.default_rng(0).permutation(len(mesh.faces))
    shuffled = parts_of(Mesh(mesh.vertices, mesh.faces[order]))
    for number in (0, 1):
        assert len(set(shuffled[parts_of(mesh)[order] == number])) == 1


# --- materials


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), most=st.integers(1, 4))
def test_dressing_changes_no_shape(seed, most):
    wall = Body(block((3, 0.1, 2), (0, 2, 1)), label=0)
    dressed = build(MIXED, max_materials=most).dress(
        (Body(stool()), wall), np.random.default_rng(seed)
    )
    mine, rest = [b for b in dressed if b.label == 1], [b for b in dressed if b.label == 0]
    assert 1 <= len(mine) <= min(most, 2)  # the legs are all of one material
    corners = [body.mesh.vertices[body.mesh.faces].reshape(-1, 9) for body in mine]
    whole = stool().vertices[stool().faces].reshape(-1, 9)
    np.testing.assert_array_equal(
        sorted(map(tuple, np.concatenate(corners))), sorted(map(tuple, whole))
    )
    assert [body.mesh for body in rest] == [wall.mesh]
    for body in dressed:
        assert 0.03 <= body.albedo <= 0.9
        assert body.gloss is not None


def test_kinds_are_drawn_by_their_weights_from_their_ranges():
    kinds = {
        "a": Kind(3.0, (0.1, 0.2), (0.3, 0.4)),
        "b": Kind(1.0, (0.6, 0.8), (0.5, 0.5), metal=True),
        "never": Kind(0.0, (0.9, 0.9), (1.0, 1.0)),
    }
    bodies = [Body(block((1, 1, 1)))] * 401
    _, *drawn = MixedMaterials(kinds).dress(bodies, np.random.default_rng(0))
    metals = [body for body in drawn if body.gloss.metal]
    assert len(metals) / 400 == pytest.approx(0.25, abs=0.07)
    albedo = np.array([body.albedo for body in metals])
    assert 0.6 <= albedo.min() < 0.62 < 0.78 < albedo.max() <= 0.8
    assert albedo.mean() == pytest.approx(0.7, abs=0.03)
    assert {body.gloss.roughness for body in metals} == {0.5}
    assert all(body.albedo <= 0.2 for body in drawn if not body.gloss.metal)


# --- the light


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


# --- whole recipes


def test_an_object_s_bytes_depend_on_its_id_and_not_on_the_others():
    words = ("domain=specklenet10", *QUICK, "views=1", *LIT)
    both = qs3.generate({"a": stool().to_trimesh(), "b": stool().to_trimesh()}, *words)
    alone = qs3.generate({"b": stool().to_trimesh()}, *words)["b"]
    np.testing.assert_array_equal(alone.points, both["b"].points)
    np.testing.assert_array_equal(
        alone.frames[0].images["left"], both["b"].frames[0].images["left"]
    )
    matt = qs3.generate({"b": stool().to_trimesh()}, *words[:-2])["b"]
    np.testing.assert_array_equal(matt.clean, alone.clean)  # it stands where it stood
    assert (matt.frames[0].images["left"] != alone.frames[0].images["left"]).mean() > 0.05
