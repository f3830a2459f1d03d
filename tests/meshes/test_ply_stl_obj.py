"""PLY, STL and OBJ: polygons of mixed sizes, text and binary, damage."""

import os

import numpy as np
import pytest
import trimesh

from qs3.datasets.clouds import parse_cloud
from qs3.meshes.io import load_mesh
from tests.meshes.written import PYRAMID, corners, export, mixed_ply, refused, save


@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_with_polygons_of_mixed_sizes(tmp_path, order):
    mesh = load_mesh(save(tmp_path, "a.ply", mixed_ply(order)))
    np.testing.assert_allclose(mesh.vertices, PYRAMID.vertices)
    assert mesh.faces.tolist() == [[0, 3, 2], [0, 2, 1], [0, 1, 4], [1, 2, 4]]


def test_text_ply_with_polygons_of_mixed_sizes(tmp_path):
    text = (
        "ply\nformat ascii 1.0\nobj_info x\nelement vertex 4\nproperty float z\nproperty float x\n"
        "property float y\nproperty uchar red\nelement face 2\n"
        "property list uchar uint vertex_index\nelement edge 1\nproperty int vertex1\nend_header\n"
        "0 0 0 1\n0 1 0 1\n0 1 1 1\n0 0 1 1\n4 0 1 2 3\n3 0 1 2\n7\n"
    )
    mesh = load_mesh(save(tmp_path, "a.ply", text))
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]


def test_coordinates_of_ply_in_capitals(tmp_path):
    text = mixed_ply("<")
    capitals = text
    for kind, axis in ((b"double", b"x"), (b"float", b"y"), (b"float", b"z")):
        capitals = capitals.replace(
            b"property " + kind + b" " + axis, b"property " + kind + b" " + axis.upper()
        )
    assert capitals != text
    expected = load_mesh(save(tmp_path, "a.ply", text))
    mesh = load_mesh(save(tmp_path, "b.ply", capitals))
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    np.testing.assert_array_equal(parse_cloud(tmp_path / "b.ply"), parse_cloud(tmp_path / "a.ply"))


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"ply\n", b"plx\n", "not a PLY"),
        (b"property double x", b"property double u", "without x"),
        (b"vertex_indices", b"other_indices", "without vertex_indices"),
        (b"element face 3", b"element fact 3", "no faces"),
        (b"element face 3", b"element face 4", "truncated"),
        (b"element face 3", b"element face 99999999", "limits"),
        (b"element junk 2", b"element junk 999999999999", "limits"),
        (b"element junk 2", b"element junk 60000000", "truncated|items"),
        (b"element junk 2", b"element junk two", "header line"),
        (b"list uchar int", b"list float int", "items|truncated"),
        (b"property uchar red", b"property colour red", "unknown type"),
        (b"comment made by hand", b"made by hand", "header line"),
        (b"binary_little_endian", b"binary_middle_endian", "header line"),
        (b"format binary_little_endian 1.0\n", b"", "header line|format"),
    ],
)
def test_broken_ply_is_refused_with_the_reason(tmp_path, old, new, reason):
    refused(tmp_path, "a.ply", mixed_ply("<").replace(old, new), reason)


def test_point_cloud_is_no_mesh(tmp_path):
    cloud = trimesh.PointCloud(PYRAMID.vertices).export(file_type="ply")
    refused(tmp_path, "a.ply", cloud, "no faces")


# ---------------------------------------------------------------------------- STL, OBJ


def test_binary_stl_that_begins_with_solid(tmp_path):
    content = b"solid of some program" + export("a.stl")[21:]
    assert len(load_mesh(save(tmp_path, "a.stl", content)).faces) == 6


def test_text_stl_with_two_solids_and_a_tricky_name(tmp_path):
    text = export("ascii.stl").decode()
    both = text.replace("solid \n", "solid vertex facet\n", 1) + text
    assert len(load_mesh(save(tmp_path, "a.stl", both)).faces) == 12
    refused(tmp_path, "a.stl", both[: len(both) - 20], "truncated")
    refused(tmp_path, "a.stl", text.replace("endloop", "vertex 1 2 3\nendloop"), "not triangles")
    refused(tmp_path, "a.stl", "solid\nendsolid\n", "no faces")


def test_obj_indices_of_all_kinds(tmp_path):
    text = (
        "mtllib nothing.mtl\no one\nv 0 0 0\nv 1 0 0 # right\nv 1 1 0 0.5 0.5 0.5\nv 0 1 0 1.0\n"
        "vt 0 0\nvn 0 0 1\nusemtl red\nf 1/1/1 2/1/1 \\\n 3/1/1 4/1/1\no two\n"
        "v 0 0 1\nv 1 0 1\nv 0 1 1\nf -3//1 -2//1 -1//1\nv 9 9 9\nl 1 2\nf 1 2/1 3\n"
    )
    mesh = load_mesh(save(tmp_path, "a.obj", text))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6], [0, 1, 2]]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "corner '0'"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "vertex 3, but there are 3"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n", "corner '-4'"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 x\n", "corner 'x'"),
        ("v 0 0\nf 1 1 1\n", "2 coordinates"),
        ("v 0 0 z\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "text where"),
        ("v 0 0 0\nv 1 0 0\nl 1 2\n", "no faces"),
        ("hello\n", "no faces"),
        (bytes(range(256)), "no faces"),
    ],
)
def test_broken_obj_is_refused_with_the_reason(tmp_path, content, reason):
    refused(tmp_path, "a.obj", content, reason)


def test_obj_with_a_byte_order_mark_has_all_its_vertices(tmp_path):
    """Without the first one, the others would be taken for each other."""
    text = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 9 9 9\nf 1 2 3\n"
    mesh = load_mesh(save(tmp_path, "a.obj", b"\xef\xbb\xbf" + text))
    np.testing.assert_array_equal(corners(mesh), [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]])


def test_obj_opens_no_other_file(tmp_path):
    os.mkfifo(tmp_path / "trap.mtl")  # opening it would wait for ever
    text = "mtllib trap.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n"
    assert len(load_mesh(save(tmp_path, "a.obj", text)).faces) == 1
