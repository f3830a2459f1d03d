"""The mesh itself: to trimesh and back."""

import numpy as np
import pytest
import trimesh

from qs3.errors import MeshError
from qs3.meshes.mesh import Mesh
from tests.meshes.written import PYRAMID, as_trimesh, corners


def test_there_and_back_nothing_changes():
    mesh = Mesh(PYRAMID.vertices, [*PYRAMID.faces[::-1], [0, 0, 1]])
    largest = mesh.vertices.max()
    solid = as_trimesh(mesh)
    assert isinstance(solid, trimesh.Trimesh)
    assert Mesh.from_trimesh(solid).sha256 == mesh.sha256
    solid.apply_scale(2)  # its own arrays
    assert mesh.vertices.max() == largest


def test_arrays_of_the_caller_stay_its_own():
    """Its vertices could not be written to any more."""
    vertices, faces = PYRAMID.vertices.copy(), PYRAMID.faces.astype(np.int32)
    mesh = Mesh(vertices, faces)
    assert not mesh.vertices.flags.writeable
    assert vertices.flags.writeable
    assert faces.flags.writeable


@pytest.mark.parametrize("wrong", [-1, 5])
def test_a_vertex_that_is_not_there_is_an_error(wrong):
    with pytest.raises(MeshError):
        Mesh(PYRAMID.vertices, [[0, 1, wrong], [0, 1, 4]])


def test_vertices_that_no_face_uses_are_left_out():
    def of(stray):
        around = [[9, 9, 9], *PYRAMID.vertices, stray]
        return Mesh.from_trimesh(trimesh.Trimesh(around, PYRAMID.faces + 1, process=False))

    assert of([8, 9, 9]).sha256 == Mesh(PYRAMID.vertices, PYRAMID.faces).sha256
    with pytest.raises(MeshError):  # of a damaged file
        of([np.nan, 9, 9])


def test_a_scene_is_put_together():
    scene = trimesh.Scene(PYRAMID)
    scene.add_geometry(PYRAMID, transform=trimesh.transformations.translation_matrix((0, 0, 5)))
    scene.add_geometry(trimesh.PointCloud([[7, 7, 7]]))
    both = np.concatenate([corners(PYRAMID), corners(PYRAMID) + np.array([0, 0, 5])])
    np.testing.assert_allclose(corners(Mesh.from_trimesh(scene)), both)
