"""Reading CAD files: what trimesh writes and what it misreads, the axis that is up, damage."""

import contextlib
import errno
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from qs3.errors import MeshError, MeshUnavailableError
from qs3.meshes.io import DECLARE_UP, is_mesh, load_mesh
from tests.meshes.written import (
    EXPORTS,
    PYRAMID,
    SQUARE_OFF,
    corners,
    export,
    gltf,
    mixed_ply,
    refused,
    save,
    threemf,
    z_up,
)

OTHERS = {
    "mixed.ply": lambda: mixed_ply("<"),
    "a.gltf": lambda: json.dumps(gltf()[0]).encode(),
    "nested.3mf": threemf,
}
every_format = pytest.mark.parametrize("name", [*EXPORTS, *OTHERS])


def content_of(name):
    return OTHERS[name]() if name in OTHERS else export(name)


@pytest.mark.parametrize("name", EXPORTS)
def test_what_trimesh_writes_is_read(tmp_path, name):
    path = save(tmp_path, name.upper(), export(name))
    expected = z_up(PYRAMID) if name.endswith("glb") else PYRAMID
    np.testing.assert_allclose(corners(load_mesh(path)), corners(expected), atol=1e-6)
    turned = expected if path.suffix.lower() in DECLARE_UP else z_up(PYRAMID)
    np.testing.assert_allclose(corners(load_mesh(path, up="y")), corners(turned), atol=1e-6)
    assert is_mesh(path)


def test_vertices_that_no_face_uses_change_nothing(tmp_path):
    """They would make furniture larger, and move where shadow rays begin."""
    square = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
    plain = load_mesh(save(tmp_path, "plain.obj", square + b"f 1 2 3 4\n"))
    stray = load_mesh(save(tmp_path, "stray.obj", b"v 500 0 0\n" + square + b"f 2 3 4 5\n"))
    assert stray.sha256 == plain.sha256


@pytest.mark.parametrize(
    "header",
    [
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
        "OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3 0.5 0.5 0.5\n",
        "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2 9\n3 0 2 3\n",
        "OFF\n4 4 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n2 0 1\n3 0 1 2\n1 0\n3 0 2 3\n",
        "COFF\n4 1 0\n0 0 0 255 0 0 1\n1 0 0 1 1 1 1\n1 1 0 0 0 0 1\n0 1 0 1 0 0 1\n4 0 1 2 3\n",
    ],
)
def test_off_polygons_and_colours(tmp_path, content):
    mesh = load_mesh(save(tmp_path, "a.off", content))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_with_polygons_of_mixed_sizes(tmp_path, order):
    mesh = load_mesh(save(tmp_path, "a.ply", mixed_ply(order)))
    np.testing.assert_allclose(mesh.vertices, PYRAMID.vertices)
    assert mesh.faces.tolist() == [[0, 3, 2], [0, 2, 1], [0, 1, 4], [1, 2, 4]]


def test_text_ply_with_polygons_of_mixed_sizes_and_capitals(tmp_path):
    text = (
        "ply\nformat ascii 1.0\nobj_info x\nelement vertex 4\nproperty float Z\nproperty float X\n"
        "property float Y\nproperty uchar red\nelement face 2\n"
        "property list uchar uint vertex_index\nelement edge 1\nproperty int vertex1\nend_header\n"
        "0 0 0 1\n0 1 0 1\n0 1 1 1\n0 0 1 1\n4 0 1 2 3\n3 0 1 2\n7\n"
    )
    mesh = load_mesh(save(tmp_path, "a.ply", text))
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]


def test_a_point_cloud_is_no_mesh(tmp_path):
    cloud = trimesh.PointCloud(PYRAMID.vertices).export(file_type="ply")
    refused(tmp_path, "a.ply", cloud)
    assert not is_mesh(tmp_path / "a.ply")


def test_binary_stl_that_begins_with_solid(tmp_path):
    content = b"solid of some program" + export("a.stl")[21:]
    assert len(load_mesh(save(tmp_path, "a.stl", content)).faces) == 6


def test_text_stl_with_two_solids(tmp_path):
    text = export("ascii.stl").decode()
    both = text + text
    assert len(load_mesh(save(tmp_path, "a.stl", both)).faces) == 12
    refused(tmp_path, "a.stl", both[: len(both) - 20])
    refused(tmp_path, "a.stl", text.replace("endloop", "vertex 1 2 3\nendloop"))
    refused(tmp_path, "a.stl", text.replace("vertex", "vertex 1", 1))


def test_obj_indices_of_all_kinds(tmp_path):
    """Those that count from the end mean the end so far; no other file is opened."""
    os.mkfifo(tmp_path / "trap.mtl")  # opening it would wait for ever
    text = (
        "\ufeffv 0 0 0\nmtllib trap.mtl\no one\nv 1 0 0 # right\nv 1 1 0 0.5 0.5 0.5\n"
        "v 0 1 0 1.0\nvt 0 0\nvn 0 0 1\nusemtl red\nf 1/1/1 2/1/1 \\\n 3/1/1 4/1/1\no two\n"
        "v 0 0 1\nv 1 0 1\nv 0 1 1\nf -3//1 -2//1 -1//1\nv 9 9 9\nl 1 2\nf 1 2/1 3\n"
    )
    mesh = load_mesh(save(tmp_path, "a.obj", text))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6], [0, 1, 2]]


PLY = mixed_ply("<")
BROKEN = {
    "a.off": [
        *("PLY\n", "OFF BINARY\n4 2 0\n", "4OFF\n4 2 0\n", "OFF\n0 0 0\n", ""),
        *(SQUARE_OFF.replace("1 1 0", f"1 {y} 0") for y in ("one", "nan", "1e999")),
        *(SQUARE_OFF.replace("3 0 2 3", f"3 0 2 {i}") for i in ("7", "-1", "4294967297", "1.5")),
        SQUARE_OFF.replace("0 1 0\n", "0 1 0\n1 1 1\n"),  # a vertex that could pass for a face
    ],
    "a.obj": [
        *(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf {face}\n" for face in ("0 1 2", "1 2 4", "1 2 -4", "1 2")),
        "v 0 0\nf 1 1 1\n",
    ],
    "a.ply": [
        PLY.replace(b"property double x", b"property double u"),
        PLY.replace(b"vertex_indices", b"other_indices"),
        PLY.replace(b"element face 3", b"element face 4"),
        PLY.replace(b"element junk 2", b"element junk 60000000"),
    ],
    "a.stl": ["solid\nendsolid\n"],
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_refused(tmp_path, name):
    for content in BROKEN[name]:
        refused(tmp_path, name, content)


@every_format
def test_cut_files_are_whole_or_refused(tmp_path, name):
    """Two formats cannot promise it everywhere.

    In text the last number may lose digits when nothing follows it; OBJ holds no counts, so it may
    lose whole faces.
    """
    content = content_of(name)
    whole = load_mesh(save(tmp_path, name, content)).sha256
    text = content.rstrip()
    last_number = len(text) - len(text.split()[-1])
    near_end = range(len(content) - 30, len(content))
    for length in sorted({*range(0, len(content), len(content) // 100 + 1), *near_end}):
        path = save(tmp_path, name, content[:length])
        with contextlib.suppress(MeshError):
            cut = load_mesh(path)
            cut_in_number = name in ("a.off", "ascii.ply") and last_number < length < len(text)
            assert cut.sha256 == whole or cut_in_number or name == "a.obj"


@every_format
def test_flipped_bytes_give_a_mesh_or_mesh_error(tmp_path, name):
    content = content_of(name)
    rng = np.random.default_rng(0)
    for _ in range(60):
        damaged = np.frombuffer(content, np.uint8).copy()
        places = rng.integers(0, len(damaged), rng.integers(1, 4))
        damaged[places] = rng.integers(0, 256, len(places))
        with contextlib.suppress(MeshError):
            load_mesh(save(tmp_path, name, damaged.tobytes()))


def test_whether_the_disk_or_the_file_is_to_blame(tmp_path, monkeypatch):
    path = save(tmp_path, "a.off", SQUARE_OFF)
    broken = OSError(errno.ESTALE, os.strerror(errno.ESTALE))
    monkeypatch.setattr(Path, "read_bytes", lambda self: (_ for _ in ()).throw(broken))
    with pytest.raises(MeshUnavailableError, match=re.escape(str(path))):
        load_mesh(path)
