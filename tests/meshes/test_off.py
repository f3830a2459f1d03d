"""OFF: headers, polygons, colours, damage."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import MeshError
from qs3.meshes.io import load_mesh
from tests.meshes.written import SQUARE_OFF, corners, refused, save


@pytest.mark.parametrize(
    "header",
    [
        "OFF\n4 2 0\n",
        "OFF4 2 0\n",  # ModelNet40
        "OFF 4 2 0\n",
        "OFF\n4 2\n",
        "# a comment\nOFF # another\n\n# and one\n4 2 5 # edges\n\n",
        "\ufeffOFF\n4 2 0\n",
    ],
)
def test_off_headers(tmp_path, header):
    mesh = load_mesh(save(tmp_path, "a.off", SQUARE_OFF.replace("OFF\n4 2 0\n", header)))
    assert mesh.vertices.shape == (4, 3)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(
    "content",
    [
        "OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n",
        "OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3 0.5 0.5 0.5\n",
        "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2 9\n3 0 2 3\n",
        "OFF\n4 4 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n2 0 1\n3 0 1 2\n1 0\n3 0 2 3\n",
        "COFF\n4 1 0\n0 0 0 255 0 0 1\n1 0 0 1 1 1 1\n1 1 0 0 0 0 1\n0 1 0 1 0 0 1\n4 0 1 2 3\n",
        "NOFF\n4 1 0\n0 0 0 0 0 1\n1 0 0 0 0 1\n1 1 0 0 0 1\n0 1 0 0 0 1\n4 0 1 2 3\n",
    ],
)
def test_off_polygons_and_colours(tmp_path, content):
    mesh = load_mesh(save(tmp_path, "a.off", content))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("PLY\n", "does not begin with OFF"),
        ("OFF BINARY\n4 2 0\n", "binary"),
        ("4OFF\n4 2 0\n", "four-dimensional"),
        ("OFF\nx y z\n", "numbers of vertices"),
        (SQUARE_OFF.replace("1 1 0", "1 one 0"), "text where numbers"),
        (SQUARE_OFF.replace("3 0 2 3", "3 0 2 7"), "vertex 7, but there are 4"),
        (SQUARE_OFF.replace("3 0 2 3", "3 0 2 -1"), "vertex -1"),
        (SQUARE_OFF.replace("3 0 2 3", "3 0 2 4294967297"), "vertex 4294967297"),
        (SQUARE_OFF.replace("3 0 2 3", "3 0 2 1.5"), "not a whole number"),
        (SQUARE_OFF.replace("3 0 2 3", "9 0 2 1"), "broken face"),
        (SQUARE_OFF.replace("1 1 0", "1 nan 0"), "not finite"),
        (SQUARE_OFF.replace("1 1 0", "1 inf 0"), "not finite"),
        (SQUARE_OFF.replace("1 1 0", "1 1e999 0"), "not finite"),
        (SQUARE_OFF.replace("1 1 0", "1 1e308 0").replace("1 0 0", "1 -1e308 0"), "too large"),
        ("OFF\n4 0 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n", "no faces"),
        ("OFF\n0 0 0\n", "no faces"),
        ("OFF\n3 1 0\n0 0 0\n1 1 1\n2 2 2\n3 0 1 2\n", "zero area"),
        ("OFF\n1 2 0\n5 5 5\n3 0 0 0\n3 0 0 0\n", "zero area"),
        ("OFF\n4 200000000 0\n", "limits"),
        ("OFF\n999999999999 1 0\n", "limits"),
        (  # the fifth vertex could pass for a polygon of one corner
            SQUARE_OFF.replace("0 1 0\n", "0 1 0\n1 1 1\n"),
            "7 lines behind its header, which promises 4 vertices and 2 faces",
        ),
        ("", "is empty"),
        (b"\0" * 100, "does not begin"),
    ],
)
def test_broken_off_is_refused_with_the_reason(tmp_path, content, reason):
    refused(tmp_path, "a.off", content, reason)


def test_one_good_face_is_enough_and_duplicates_are_accepted(tmp_path):
    text = "OFF\n3 4 0\n0 0 0\n1 0 0\n0 1 0\n3 0 0 1\n3 0 1 2\n3 0 1 2\n3 2 1 0\n"
    assert len(load_mesh(save(tmp_path, "a.off", text)).faces) == 4


def test_a_thin_and_a_distant_mesh_have_area(tmp_path):
    thin = SQUARE_OFF.replace("1 1 0", "1 1e-6 0").replace("0 1 0", "0 1e-6 0")
    far = SQUARE_OFF.replace("0 0 0\n", "1e6 1e6 0\n").replace("1 1 0", "1e6 1000001 0")
    assert len(load_mesh(save(tmp_path, "thin.off", thin)).faces) == 2
    assert len(load_mesh(save(tmp_path, "far.off", far)).faces) == 2


@settings(max_examples=60, deadline=None)
@given(
    polygons=st.lists(st.lists(st.integers(0, 9), min_size=3, max_size=7), min_size=1, max_size=6),
    colours=st.booleans(),
)
def test_convex_polygons_become_fans(tmp_path_factory, polygons, colours):
    """In OFF, PLY and OBJ alike, vertices unchanged to the last bit."""
    folder = tmp_path_factory.getbasetemp()
    rng = np.random.default_rng(len(polygons))
    angles = np.sort(rng.uniform(0, 2 * np.pi, 10))
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = circle @ rng.normal(size=(2, 3)) + rng.normal(size=3)
    polygons = [sorted(corners) for corners in polygons]
    points = [" ".join(map(repr, v)) for v in vertices.tolist()]
    faces = [" ".join(map(str, [len(p), *p])) for p in polygons]
    paint = " 0.1 0.2 0.3" if colours else ""
    off = [f"OFF\n10 {len(faces)} 0", *points, *(face + paint for face in faces)]
    ply = [
        f"ply\nformat ascii 1.0\nelement vertex 10\nproperty double x\nproperty double y\n"
        f"property double z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\n"
        "end_header",
        *points,
        *faces,
    ]
    obj = [*(f"v {p}" for p in points)]
    obj += ["f " + " ".join(str(i + 1) for i in p) for p in polygons]
    expected = [[p[0], p[i], p[i + 1]] for p in polygons for i in range(1, len(p) - 1)]
    flat = all(len(set(triangle)) < 3 for triangle in expected)
    for name, lines in [("a.off", off), ("a.ply", ply), ("a.obj", obj)]:
        path = save(folder, name, "\n".join(lines))
        if flat:
            with pytest.raises(MeshError, match="zero area"):
                load_mesh(path)
        else:
            np.testing.assert_array_equal(corners(load_mesh(path)), vertices[expected])
