"""Reading CAD files: formats, damage, and files that mean harm. trimesh is the reference."""

import base64
import contextlib
import json
import os
import pickle
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import MeshError
from qs3.meshes import files
from qs3.meshes.files import load_mesh
from qs3.meshes.formats import arrays

SQUARE_OFF = "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
PYRAMID = trimesh.Trimesh(
    [[0, 0, 0], [1.5, 0, 0], [1.25, 1, 0], [0, 1, 0.125], [0.5, 0.5, 2]],
    [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [0, 2, 1], [0, 3, 2]],
    process=False,
)


def corners(mesh):
    """[F, 3, 3]: what is compared, since formats order and repeat vertices as they like."""
    return np.asarray(mesh.vertices)[np.asarray(mesh.faces)]


def save(folder, name, content):
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refused(folder, name, content, reason):
    path = save(folder, name, content)
    with pytest.raises(MeshError, match=reason) as caught:
        load_mesh(path)
    assert str(path) in str(caught.value)


def z_up(mesh):
    turned = mesh.copy()
    turned.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    return turned


def export(name):
    """Bytes of the pyramid in a format of trimesh's, by file name."""
    kind = name.rpartition(".")[2]
    if name == "ascii.ply":
        return PYRAMID.export(file_type="ply", encoding="ascii")
    if name == "ascii.stl":
        return PYRAMID.export(file_type="stl_ascii").encode()
    content = PYRAMID.export(file_type=kind)
    return content.encode() if isinstance(content, str) else content


EXPORTS = ["a.off", "a.ply", "ascii.ply", "a.stl", "ascii.stl", "a.obj", "a.glb"]


@pytest.mark.parametrize("name", EXPORTS)
def test_what_trimesh_writes_is_read(tmp_path, name):
    mesh = load_mesh(save(tmp_path, name, export(name)))
    expected = z_up(PYRAMID) if name.endswith("glb") else PYRAMID
    np.testing.assert_allclose(corners(mesh), corners(expected), atol=1e-6)


@pytest.mark.parametrize("newline", [b"\r\n", b"\r"])
def test_suffix_in_capitals_and_other_line_ends(tmp_path, newline):
    for name in ("a.off", "ascii.ply", "ascii.stl", "a.obj"):
        content = export(name).replace(b"\n", newline)
        mesh = load_mesh(save(tmp_path, name.upper(), content))
        np.testing.assert_allclose(corners(mesh), corners(PYRAMID), atol=1e-6)


# ---------------------------------------------------------------------------- OFF


@pytest.mark.parametrize(
    "header",
    [
        "OFF\n4 2 0\n",
        "OFF4 2 0\n",  # ModelNet40
        "OFF 4 2 0\n",
        "OFF\r\n4 2 0\r\n",
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
        (SQUARE_OFF.replace("3 0 2 3", "3 0 2 1.5"), "no whole number"),
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
def test_polygons_become_fans(tmp_path_factory, polygons, colours):
    """In OFF, PLY and OBJ alike, vertices unchanged to the last bit."""
    folder = tmp_path_factory.getbasetemp()
    vertices = np.random.default_rng(len(polygons)).normal(size=(10, 3))
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
            assert load_mesh(path).faces.tolist() == expected
            np.testing.assert_array_equal(load_mesh(path).vertices, vertices)


# ---------------------------------------------------------------------------- PLY


def mixed_ply(order, extras=b""):
    """A quad and two triangles, with properties before, between and behind."""
    kind = {"<": b"binary_little_endian", ">": b"binary_big_endian"}[order]
    header = (
        b"ply\nformat " + kind + b" 1.0\ncomment made by hand\nelement junk 2\n"
        b"property list uchar short stuff\nelement vertex 5\nproperty uchar quality\n"
        b"property double x\nproperty float y\nproperty float z\nelement face 3\n"
        b"property uchar red\nproperty list uchar int vertex_indices\nproperty float area\n"
        b"end_header\n"
    )
    body = struct.pack(order + "BhBhh", 1, 7, 2, 8, 9)
    for point in PYRAMID.vertices:
        body += struct.pack(order + "Bdff", 9, *point)
    for face in ([0, 3, 2, 1], [0, 1, 4], [1, 2, 4]):
        body += struct.pack(order + "BB", 200, len(face))
        body += struct.pack(f"{order}{len(face)}if", *face, 0.5)
    return header + body + extras


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


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"ply\n", b"plx\n", "no PLY"),
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


def test_obj_opens_no_other_file(tmp_path):
    os.mkfifo(tmp_path / "trap.mtl")  # opening it would wait for ever
    text = "mtllib trap.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n"
    assert len(load_mesh(save(tmp_path, "a.obj", text)).faces) == 1


# ---------------------------------------------------------------------------- glTF


def gltf(**changes):
    """A square as triangles, strip and fan, in one mesh, placed by two nodes."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype="<f4")
    indices = np.array([0, 1, 2, 2, 1, 3, 0, 1, 2, 3, 0, 1, 3, 2], dtype="<u2")
    blob = points.tobytes() + indices.tobytes()
    accessor = {"bufferView": 1, "componentType": 5123, "type": "SCALAR"}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 2]}],
        "nodes": [
            {"children": [1], "translation": [10, 0, 0], "scale": [2, 2, 2]},
            {"mesh": 0, "camera": 0, "rotation": [0, 0, 2**-0.5, 2**-0.5]},
            {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 7, 1]},
        ],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0}, "indices": 1},
                    {"attributes": {"POSITION": 0}, "indices": 2, "mode": 5},
                    {"attributes": {"POSITION": 0}, "indices": 3, "mode": 6},
                    {"attributes": {"POSITION": 0}, "mode": 0},
                ]
            }
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4},
            {**accessor, "count": 6},
            {**accessor, "count": 4, "byteOffset": 12},
            {**accessor, "count": 4, "byteOffset": 20},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 28},
        ],
        "buffers": [
            {
                "byteLength": 76,
                "uri": "data:application/octet-stream;base64," + base64.b64encode(blob).decode(),
            }
        ],
    }
    return {**tree, **changes}, blob


def test_gltf_scene_with_strips_fans_and_transforms(tmp_path):
    tree, _ = gltf()
    mesh = load_mesh(save(tmp_path, "a.gltf", json.dumps(tree)))
    assert len(mesh.faces) == 12
    first, second = mesh.vertices[:12], mesh.vertices[12:]
    # turned by 90 degrees about z, doubled, moved; then y up becomes z up
    np.testing.assert_allclose([first.min(0), first.max(0)], [[8, 0, 0], [10, 0, 2]], atol=1e-6)
    np.testing.assert_allclose([second.min(0), second.max(0)], [[0, -7, 0], [1, -7, 1]])
    doubled = np.cross(*(np.diff(corners(mesh), axis=1)[:, i] for i in range(2)))
    assert np.linalg.norm(doubled, axis=1).sum() / 2 == pytest.approx(3 * 4 + 3 * 1)


def test_gltf_is_read_alike_every_time(tmp_path):
    scene = trimesh.Scene([PYRAMID, trimesh.creation.box()])
    path = save(tmp_path, "a.glb", scene.export(file_type="glb"))
    assert len({load_mesh(path).sha256 for _ in range(5)}) == 1
    theirs = z_up(trimesh.load_mesh(path))
    ours = trimesh.Trimesh(*(getattr(load_mesh(path), name) for name in ("vertices", "faces")))
    assert ours.area == pytest.approx(theirs.area)
    np.testing.assert_allclose(ours.bounds, theirs.bounds, atol=1e-6)


def test_gltf_quantized_strided_and_without_scenes(tmp_path):
    points = np.zeros((3, 4), dtype="<i2")
    points[:, :3] = [[0, 0, 0], [32767, 0, 0], [0, 32767, -32768]]
    tree, _ = gltf()
    tree.pop("scenes")
    tree["extensionsRequired"] = ["KHR_mesh_quantization", "KHR_materials_unlit"]
    tree["nodes"] = [{"mesh": 0}]
    tree["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0}}]}]
    shape = {"componentType": 5122, "type": "VEC3", "count": 3, "normalized": True}
    tree["accessors"] = [{"bufferView": 0, **shape}]
    tree["bufferViews"] = [{"buffer": 0, "byteLength": 24, "byteStride": 8}]
    tree["buffers"] = [{"byteLength": 24, "uri": "my%20points.bin"}]
    save(tmp_path, "my points.bin", points.tobytes())
    mesh = load_mesh(save(tmp_path, "a.gltf", json.dumps(tree)))
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 1]]


@pytest.mark.parametrize(
    "uri", ["../secret.bin", "/etc/passwd", "link.bin", "sub/../../secret.bin"]
)
def test_gltf_reads_nothing_outside_of_its_folder(tmp_path, uri):
    tree, blob = gltf()
    folder = tmp_path / "mesh"
    folder.mkdir()
    save(tmp_path, "secret.bin", blob)
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    tree["buffers"] = [{"byteLength": 76, "uri": uri}]
    refused(folder, "a.gltf", json.dumps(tree), "outside of its folder")


@pytest.mark.parametrize(
    "uri", ["gone.bin", "http://example.com/a.bin", "file:///etc/passwd", ".", "data:,xyz"]
)
def test_gltf_buffers_that_are_not_there(tmp_path, uri):
    tree, _ = gltf(buffers=[{"byteLength": 76, "uri": uri}])
    refused(tmp_path, "a.gltf", json.dumps(tree), "not there|truncated")


def changed(path, value):
    tree, _ = gltf()
    place = tree
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return tree


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        (("asset", "version"), "1.0", "version 2"),
        (("extensionsRequired",), ["KHR_draco_mesh_compression"], "KHR_draco"),
        (("nodes", 1, "children"), [0], "within itself"),
        (("nodes", 2, "children"), [1], "two places"),
        (("nodes", 2, "skin"), 0, "skinned"),
        (("accessors", 0, "sparse"), {}, "sparse"),
        (("accessors", 0, "count"), 5, "GLTF"),
        (("accessors", 0, "count"), -1, "GLTF"),
        (("accessors", 0, "count"), 10**12, "limits"),
        (("accessors", 0, "type"), "MAT4", "type MAT4"),
        (("accessors", 0, "byteOffset"), -4, "GLTF"),
        (("accessors", 1, "byteOffset"), 10**9, "GLTF"),
        (("bufferViews", 0, "byteStride"), 1, "truncated"),
        (("bufferViews", 0, "byteLength"), 10**9, "truncated"),
        (("bufferViews", 0, "byteOffset"), 40, "vertex|truncated|finite|area|GLTF"),
        (("bufferViews", 1, "byteOffset"), 0, "vertex"),
        (("meshes", 0, "primitives", 0, "mode"), 9, "mode 9"),
        (("meshes", 0, "primitives"), [], "no faces"),
        (("meshes",), {}, "GLTF"),
        (("buffers", 0, "uri"), 5, "GLTF"),
        (("buffers",), [{}], "without data"),
        (("scene",), 3, "GLTF"),
    ],
)
def test_broken_gltf_is_refused_with_the_reason(tmp_path, path, value, reason):
    refused(tmp_path, "a.gltf", json.dumps(changed(path, value)), reason)


@pytest.mark.parametrize("text", ["[]", "{", "5", "[" * 100_000, '{"asset": []}', "{}"])
def test_json_that_is_no_gltf(tmp_path, text):
    refused(tmp_path, "a.gltf", text, "glTF|GLTF")


def test_gltf_that_repeats_a_mesh_beyond_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(arrays, "MAX_FACES", 1000)
    tree, _ = gltf(nodes=[{"mesh": 0}] * 500, scenes=[{"nodes": list(range(500))}])
    refused(tmp_path, "a.gltf", json.dumps(tree), "limits")


# ---------------------------------------------------------------------------- COLLADA

GEOMETRY = """
<library_geometries>
  <geometry id="g"><mesh>
    <source id="p"><float_array id="pa" count="18">9 0 0 0 1 0 0 1 1 0 0 1 0 5 5 5 6 6</float_array>
      <technique_common><accessor source="#pa" count="4" stride="3" offset="1"/></technique_common>
    </source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    {primitive}
  </mesh></geometry>
</library_geometries>"""
TRIANGLES = """<triangles count="2"><input semantic="VERTEX" source="#v" offset="0"/>
  <input semantic="NORMAL" source="#v" offset="1"/><p>0 9 1 9 2 9 0 9 2 9 3 9</p></triangles>"""
PRIMITIVES = {
    "triangles": TRIANGLES,
    "polylist": """<polylist count="1"><input semantic="NORMAL" source="#v" offset="0"/>
      <input semantic="VERTEX" source="#v" offset="1"/><vcount>4</vcount>
      <p>7 0 7 1 7 2 7 3</p></polylist>""",
    "polygons": """<polygons count="2"><input semantic="VERTEX" source="#v" offset="0"/>
      <p>0 1 2</p><p>0 2 3</p></polygons><lines><input semantic="VERTEX" source="#v"/></lines>""",
}


def dae(
    primitive=TRIANGLES, nodes='<node><instance_geometry url="#g"/></node>', head="", up="Z_UP"
):
    return f"""<?xml version="1.0" encoding="utf-8"?>{head}
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.5" name="half"/><up_axis>{up}</up_axis></asset>
{GEOMETRY.format(primitive=primitive)}
<library_nodes><node id="n"><instance_geometry url="#g"/></node>
  <node id="loop"><instance_node url="#loop"/></node></library_nodes>
<library_visual_scenes><visual_scene id="s">{nodes}</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_collada_primitives(tmp_path, kind):
    mesh = load_mesh(save(tmp_path, "a.dae", dae(PRIMITIVES[kind])))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.vertices.tolist() == [[0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0]]


@pytest.mark.parametrize(
    ("up", "high"),
    [("X_UP", [0, 0, 0.5]), ("Y_UP", [0.5, 0, 0.5]), ("Z_UP", [0.5, 0.5, 0])],
)
def test_collada_axes(tmp_path, up, high):
    mesh = load_mesh(save(tmp_path, "a.dae", dae(up=up)))
    np.testing.assert_allclose(mesh.bounds[1], high, atol=1e-12)


def test_collada_transforms_in_order(tmp_path):
    nodes = """<node><translate>10 0 0</translate><rotate>0 0 1 90</rotate><scale>2 4 1</scale>
      <node><matrix>1 0 0 1  0 1 0 0  0 0 1 3  0 0 0 1</matrix><instance_node url="#n"/></node>
      <instance_geometry url="#g"/></node>"""
    mesh = load_mesh(save(tmp_path, "a.dae", dae(nodes=nodes)))
    here, inner = mesh.vertices[:4] * 2, mesh.vertices[4:] * 2
    np.testing.assert_allclose(here[[1, 3]], [[10, 2, 0], [6, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(inner[[1, 3]], [[10, 4, 3], [6, 2, 3]], atol=1e-12)


LAUGHS = """<!DOCTYPE lolz [<!ENTITY a "haha"><!ENTITY b "&a;&a;&a;&a;">]>"""


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (dae(head=LAUGHS), "document type"),
        (dae(head=LAUGHS).replace("utf-8", "utf-16").encode("utf-16"), "document type"),
        (dae(head='<!DOCTYPE x SYSTEM "file:///etc/passwd">'), "document type"),
        (dae(nodes='<node><instance_node url="#loop"/></node>'), "within themselves"),
        (dae(nodes='<node><instance_geometry url="other.dae#g"/></node>'), "not in this file"),
        (dae(nodes='<node><instance_controller url="#g"/></node>'), "skinned"),
        (dae(nodes="<node/>"), "no faces"),
        (dae(nodes="<node><lookat>1</lookat></node>"), "lookat"),
        (dae(TRIANGLES.replace("3 9<", "4 9<")), "vertex that is not among 4"),
        (dae(TRIANGLES.replace("3 9<", "-1 9<")), "vertex that is not among 4"),
        (dae(TRIANGLES.replace(" 3 9<", "<")), "add up|COLLADA|DAE"),
        (dae(TRIANGLES.replace("triangles", "tristrips")), "tristrips"),
        (dae().replace('count="4"', 'count="40"'), "fewer coordinates"),
        ("<COLLADA/>", "no visual scene"),
        ("<html/>", "no COLLADA"),
        ("hello", "no XML"),
    ],
)
def test_broken_collada_is_refused_with_the_reason(tmp_path, content, reason):
    refused(tmp_path, "a.dae", content, reason)


# ---------------------------------------------------------------------------- damage


@pytest.mark.parametrize("name", [*EXPORTS, "mixed.ply", "a.gltf", "a.dae"])
def test_cut_files_are_whole_or_refused(tmp_path, name):
    """At many lengths: the same mesh, or MeshError.

    Two formats cannot promise it everywhere. In text the last number may lose digits when
    nothing follows it; OBJ holds no counts, so it may lose whole faces.
    """
    content = {
        "mixed.ply": lambda: mixed_ply("<"),
        "a.gltf": lambda: json.dumps(gltf()[0]).encode(),
        "a.dae": lambda: dae().encode(),
    }.get(name, lambda: export(name))()
    whole = load_mesh(save(tmp_path, name, content)).sha256
    text = content.rstrip()
    last_number = len(text) - len(text.split()[-1])
    survived = 0
    step = len(content) // 500 + 1
    near_end = range(len(content) - 60, len(content))
    for length in sorted({*range(0, len(content), step), *near_end}):
        path = save(tmp_path, name, content[:length])
        try:
            cut = load_mesh(path)
        except MeshError:
            continue
        survived += 1
        cut_in_number = name in ("a.off", "ascii.ply") and last_number < length < len(text)
        assert cut.sha256 == whole or cut_in_number or name == "a.obj"
    if name not in ("a.obj", "ascii.stl"):  # the one ends anywhere, the other after endsolid
        assert survived <= 3


@pytest.mark.parametrize("name", [*EXPORTS, "mixed.ply", "a.gltf", "a.dae"])
def test_flipped_bytes_give_a_mesh_or_mesh_error(tmp_path, name):
    content = {
        "mixed.ply": lambda: mixed_ply(">"),
        "a.gltf": lambda: json.dumps(gltf()[0]).encode(),
        "a.dae": lambda: dae().encode(),
    }.get(name, lambda: export(name))()
    rng = np.random.default_rng(0)
    for _ in range(150):
        damaged = np.frombuffer(content, np.uint8).copy()
        places = rng.integers(0, len(damaged), rng.integers(1, 4))
        damaged[places] = rng.integers(0, 256, len(places))
        with contextlib.suppress(MeshError):
            load_mesh(save(tmp_path, name, damaged.tobytes()))


@settings(max_examples=200, deadline=None)
@given(content=st.binary(max_size=300), suffix=st.sampled_from(files.SUFFIXES))
def test_random_bytes_give_mesh_error(tmp_path_factory, content, suffix):
    path = save(tmp_path_factory.getbasetemp(), f"random{suffix}", content)
    with pytest.raises(MeshError):
        load_mesh(path)


# ---------------------------------------------------------------------------- the file itself


def test_files_that_are_none(tmp_path):
    (tmp_path / "folder.off").mkdir()
    os.mkfifo(tmp_path / "fifo.off")
    for name, reason in [
        ("folder.off", "is no file"),
        ("fifo.off", "is no file"),
        ("gone.off", "does not exist"),
        ("a.step", "no known format"),
    ]:
        with pytest.raises(MeshError, match=reason):
            load_mesh(tmp_path / name)


def test_size_limits(tmp_path, monkeypatch):
    path = save(tmp_path, "a.off", SQUARE_OFF)
    monkeypatch.setattr(arrays, "MAX_FACES", 1)
    with pytest.raises(MeshError, match="limits"):
        load_mesh(path)
    monkeypatch.setattr(files, "MAX_BYTES", 10)
    with pytest.raises(MeshError, match="more than the limit"):
        load_mesh(path)


def test_huge_sparse_file_is_not_read(tmp_path):
    path = tmp_path / "huge.off"
    with path.open("wb") as handle:
        handle.truncate(files.MAX_BYTES + 1)
    with pytest.raises(MeshError, match="more than the limit"):
        load_mesh(path)


def test_loading_is_silent_and_errors_travel_between_processes(tmp_path, caplog, capfd):
    load_mesh(save(tmp_path, "a.off", SQUARE_OFF))
    with pytest.raises(MeshError) as caught:
        load_mesh(save(tmp_path, "a.glb", b"glTF" + bytes(30)))
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    assert not caplog.records
    assert capfd.readouterr() == ("", "")
