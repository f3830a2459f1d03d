import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import MeshError
from qs3.generation.command import generate
from qs3.generation.scenes import Room
from qs3.meshes.mesh import Mesh
from qs3.meshes.placement import RealSize, UnitCube
from tests.generation.generating import config

EYES = np.array([[1.5, 0.0, 0.8], [1.3, 1.0, 0.6]])


def box(size=(0.4, 0.6, 0.9), at=(5.0, -3.0, 2.0)):
    solid = trimesh.creation.box(size)
    return Mesh(solid.vertices + np.array(at), solid.faces)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), unit=st.sampled_from([1.0, 1000.0, 0.0254]))
def test_unit_cube_forgets_unit_and_place(seed, unit):
    mesh = box()
    placed = UnitCube().place(Mesh(mesh.vertices * unit, mesh.faces), np.random.default_rng(seed))
    again = UnitCube().place(mesh, np.random.default_rng(seed))
    np.testing.assert_allclose(placed.vertices, again.vertices, atol=1e-9)
    low, high = placed.bounds
    np.testing.assert_allclose(low + high, 0, atol=1e-9)
    assert (high - low)[2] == pytest.approx(1.0)  # the largest side is the height


def test_without_yaw_an_object_stays_turned_as_its_file_has_it():
    """And what is drawn after it is the same."""
    some, other = np.random.default_rng(3), np.random.default_rng(3)
    placed = UnitCube(yaw=False).place(box(), some)
    np.testing.assert_allclose(np.ptp(placed.vertices, axis=0), np.array([0.4, 0.6, 0.9]) / 0.9)
    UnitCube().place(box(), other)
    assert some.random() == other.random()


def test_real_size_keeps_metres_and_stands_on_the_floor():
    placed = RealSize().place(box(), np.random.default_rng(0))
    low, high = placed.bounds
    assert low[2] == pytest.approx(0)
    assert high[2] == pytest.approx(0.9)
    in_mm = Mesh(box().vertices * 1000, box().faces)
    scaled = RealSize(fallback_side_m=1.0).place(in_mm, np.random.default_rng(0))
    assert scaled.bounds[1, 2] == pytest.approx(1.0)


def test_a_mesh_without_extent_is_refused():
    point = Mesh(np.ones((3, 3)), np.array([[0, 1, 2]]))
    with pytest.raises(MeshError):
        UnitCube().place(point, np.random.default_rng(0))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), placing=st.sampled_from([RealSize(), UnitCube()]))
def test_a_room_leaves_the_object_its_place(seed, placing):
    """Wherever the object is put: a unit cube about the origin stands on a floor below it."""
    placed = placing.place(box(), np.random.default_rng(seed))
    bodies = Room().bodies(placed, EYES, np.random.default_rng(seed))
    assert [body.label for body in bodies].count(1) == 1
    assert bodies[0].mesh is placed
    low, high = placed.bounds
    centre = (low + high)[:2] / 2
    radius = np.hypot(*(high - low)[:2]) / 2
    floor, *rest = bodies[1:]
    assert floor.mesh.bounds[1, 2] == pytest.approx(low[2], abs=1e-3)
    for body in rest:
        assert 0.25 <= body.albedo <= 0.9
        assert body.mesh.bounds[0, 2] == pytest.approx(low[2], abs=1e-9)
        corners = body.mesh.vertices[:, :2] - centre
        if np.ptp(body.mesh.bounds[:, 2]) < 2.5:  # not the wall
            assert np.linalg.norm(corners, axis=1).min() > radius
            for eye in EYES:
                assert not ((eye > body.mesh.bounds[0]) & (eye < body.mesh.bounds[1])).all()
        else:  # the wall is behind the object as seen from the cameras
            assert (corners.mean(axis=0) @ EYES[:, :2].mean(axis=0)) < -radius


@pytest.mark.parametrize(("per_metre", "warned"), [(1000, 1), (1, 0)])
def test_sizes_that_will_be_lost_are_warned_of(per_metre, warned, tmp_path, caplog):
    (tmp_path / "chair").mkdir()
    for name, side in (("a", 0.6), ("b", 1.1), ("c", 1.8)):
        solid = trimesh.creation.box([0.5 * per_metre, 0.3 * per_metre, side * per_metre])
        solid.export(tmp_path / "chair" / f"{name}.stl")
    words = ("classes=[chair]", "workers=0", "~recipe.placing.yaw", "recipe.points=64")
    placing = "recipe.placing._target_=qs3.meshes.placement.RealSize"
    generate(config(tmp_path / "data", tmp_path, placing, *words, domain="modelnet10"))
    assert caplog.text.count("are not in metres") == warned
