"""glTF and GLB: scenes, buffers, and files that mean harm."""

import json
import struct

import numpy as np
import pytest
import trimesh

from qs3.meshes.formats import arrays
from qs3.meshes.formats.gltf import buffer_files
from qs3.meshes.io import load_mesh
from tests.meshes.written import PYRAMID, corners, gltf, refused, save, z_up


def test_gltf_scene_with_strips_and_transforms(tmp_path):
    tree, _ = gltf()
    mesh = load_mesh(save(tmp_path, "a.gltf", json.dumps(tree)))
    assert len(mesh.faces) == 12
    first, second = mesh.vertices[:12], mesh.vertices[12:]
    # turned by 90 degrees about z, doubled, moved; then y up becomes z up
    np.testing.assert_allclose([first.min(0), first.max(0)], [[8, 0, 0], [10, 0, 2]], atol=1e-6)
    np.testing.assert_allclose([second.min(0), second.max(0)], [[0, -7, 0], [1, -7, 1]])
    doubled = np.cross(*(np.diff(corners(mesh), axis=1)[:, i] for i in range(2)))
    assert np.linalg.norm(doubled, axis=1).sum() / 2 == pytest.approx(3 * 4 + 3 * 1)


def test_gltf_is_read_as_trimesh_reads_it(tmp_path):
    scene = trimesh.Scene([PYRAMID, trimesh.creation.box()])
    path = save(tmp_path, "a.glb", scene.export(file_type="glb"))
    theirs, ours = z_up(trimesh.load_mesh(path)), load_mesh(path).to_trimesh()
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


def test_hidden_nodes_are_left_out_with_all_below(tmp_path, caplog):
    for hidden, left in ((0, 1), (1, 1), (2, 0)):
        tree, _ = gltf(extensionsRequired=["KHR_node_visibility"])
        only, _ = gltf(scenes=[{"nodes": [[0], [2]][left]}])
        tree["nodes"][hidden]["extensions"] = {"KHR_node_visibility": {"visible": False}}
        mesh = load_mesh(save(tmp_path, "a.gltf", json.dumps(tree)))
        expected = load_mesh(save(tmp_path, "b.gltf", json.dumps(only)))
        np.testing.assert_array_equal(mesh.vertices, expected.vertices)
        np.testing.assert_array_equal(mesh.faces, expected.faces)
        assert "1 node is hidden, and left out with all below" in caplog.text
        caplog.clear()
    for node in tree["nodes"]:
        node["extensions"] = {"KHR_node_visibility": {"visible": True}}
    assert len(load_mesh(save(tmp_path, "a.gltf", json.dumps(tree))).faces) == 12
    assert not caplog.text


def test_an_empty_list_of_scenes_is_none(tmp_path):
    tree, _ = gltf(scenes=[])
    whole = load_mesh(save(tmp_path, "a.gltf", json.dumps(gltf()[0])))
    mesh = load_mesh(save(tmp_path, "b.gltf", json.dumps(tree)))
    np.testing.assert_array_equal(mesh.vertices, whole.vertices)


def test_buffers_beside_a_file_are_found_and_those_within_it_are_not_looked_for(tmp_path):
    tree, blob = gltf()
    inside = tree["buffers"][0]
    beside = {"byteLength": 76, "uri": "my%20points.bin"}
    expected = save(tmp_path, "my points.bin", blob)
    for name in ("a.gltf", "A.GLTF"):
        path = save(tmp_path, name, json.dumps({**tree, "buffers": [inside, beside, beside]}))
        assert buffer_files(path) == [expected]
    assert buffer_files(save(tmp_path, "a.gltf", json.dumps(tree))) == []
    text = json.dumps({**tree, "buffers": [{"byteLength": 76}, beside]}).encode()
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A)
    assert buffer_files(save(tmp_path, "a.glb", head + text)) == [expected]
    for damaged in (b"", b"glTF", head, head + text[:-1], b"[]", b'{"asset": 1, "buffers": 2}'):
        assert buffer_files(save(tmp_path, "a.glb", damaged)) == []
        assert buffer_files(save(tmp_path, "a.gltf", damaged)) == []


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
    assert buffer_files(folder / "a.gltf") == []


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
        (("accessors", 0, "count"), -1, "not allow"),
        (("accessors", 0, "count"), 10**12, "limits"),
        (("accessors", 0, "type"), "MAT4", "type MAT4"),
        (("accessors", 0, "byteOffset"), -4, "not allow"),
        (("accessors", 1, "byteOffset"), 10**9, "GLTF"),
        (("bufferViews", 0, "byteStride"), 1, "not allow"),
        (("bufferViews", 0, "byteLength"), 10**9, "truncated"),
        (("bufferViews", 0, "byteOffset"), 40, "vertex|truncated|finite|area|GLTF"),
        (("bufferViews", 1, "byteOffset"), 0, "vertex"),
        (("meshes", 0, "primitives", 0, "mode"), 9, "mode 9"),
        (("meshes", 0, "primitives", 2, "mode"), 6, "triangle fans"),
        (("meshes", 0, "primitives"), [], "no faces"),
        (("meshes",), {}, "GLTF"),
        (("buffers", 0, "uri"), 5, "GLTF"),
        (("buffers",), [{}], "without data"),
        (("scene",), 3, "has no scene 3"),
        (("scene",), -1, "has no scene -1"),
        (("nodes", 2, "extensions"), {"EXT_mesh_gpu_instancing": {}}, "export each as a node"),
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


def test_morph_targets_that_move_vertices_are_refused(tmp_path):
    """A node's weights count before its mesh's; colliders' count for nothing."""

    def text(target="POSITION", mesh=None, node=None, name=""):
        tree, _ = gltf()
        for part in tree["meshes"][0]["primitives"]:
            part["targets"] = [{"NORMAL": 0}, {target: 0}]
        tree["meshes"][0] |= {"weights": mesh} if mesh else {}
        tree["meshes"].append({"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]})
        tree["nodes"][2] |= {"weights": node} if node else {}
        tree["nodes"][2]["name"] = name
        return json.dumps(tree)

    plain = len(load_mesh(save(tmp_path, "a.gltf", text())).faces)
    for fine in (
        {"mesh": [0, 0]},
        {"mesh": [1.0, 0]},
        {"mesh": [1, 1], "target": "NORMAL"},
        {"node": [0.5]},
    ):
        assert len(load_mesh(save(tmp_path, "a.gltf", text(**fine))).faces) == plain
    refused(tmp_path, "a.gltf", text(mesh=[0, 0.25]), "morph target with the weight 0.25")
    refused(tmp_path, "a.gltf", text(mesh=[0, 0], node=[0, -1]), "morph target with the weight -1")
    left_out = save(tmp_path, "b.gltf", text(node=[0, 1], name="UCX_a"))
    assert 0 < len(load_mesh(left_out).faces) < plain
