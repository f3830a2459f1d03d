"""Formats of scenes: glTF and 3MF, where instances stand, and nodes that are left out."""

import json
import struct

import numpy as np
import pytest
import trimesh

from qs3.meshes.io import load_mesh
from qs3.meshes.mesh import Mesh, is_collider
from qs3.meshes.scenes import buffer_files
from tests.meshes.written import (
    MESH_3MF,
    PYRAMID,
    RESOURCES,
    TRIANGLE,
    corners,
    gltf,
    item,
    refused,
    save,
    threemf,
)


def save_gltf(folder, tree, name="a.gltf"):
    return save(folder, name, json.dumps(tree))


def test_gltf_scene_with_strips_and_transforms(tmp_path):
    mesh = load_mesh(save_gltf(tmp_path, gltf()[0]))
    assert len(mesh.faces) == 12
    first, second = mesh.vertices[12:], mesh.vertices[:12]
    # turned by 90 degrees about z, doubled, moved; then y up becomes z up
    np.testing.assert_allclose([first.min(0), first.max(0)], [[8, 0, 0], [10, 0, 2]], atol=1e-6)
    np.testing.assert_allclose([second.min(0), second.max(0)], [[0, -7, 0], [1, -7, 1]])
    doubled = np.cross(*(np.diff(corners(mesh), axis=1)[:, i] for i in range(2)))
    assert np.linalg.norm(doubled, axis=1).sum() / 2 == pytest.approx(3 * 4 + 3 * 1)


def test_buffers_within_a_file_are_not_looked_for(tmp_path):
    tree, blob = gltf()
    assert buffer_files(save_gltf(tmp_path, tree)) == []
    beside = {"byteLength": 76, "uri": "b.bin"}
    expected = save(tmp_path, "b.bin", blob)
    text = json.dumps({**tree, "buffers": [{"byteLength": 76}, beside]}).encode()
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A)
    assert buffer_files(save(tmp_path, "a.glb", head + text)) == [expected]
    for damaged in (b"", b"glTF", head + text[:-1], b'{"asset": 1, "buffers": 2}'):
        assert buffer_files(save(tmp_path, "a.glb", damaged)) == []


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("asset", "version"), "1.0"),
        (("extensionsRequired",), ["KHR_draco_mesh_compression"]),
        (("extensionsUsed",), ["EXT_mesh_gpu_instancing"]),
        (("nodes", 0, "camera"), 0),
        (("nodes", 2, "skin"), 0),
        (("nodes", 2, "weights"), [0, -1]),
        (("meshes", 0, "weights"), [0.5]),
        (("accessors", 0, "sparse"), {}),
        (("accessors", 0, "normalized"), True),
        (("accessors", 0, "count"), 5),
        (("accessors", 1, "byteOffset"), 10**9),
        (("bufferViews", 1, "byteOffset"), 0),
        (("buffers", 0, "uri"), "gone.bin"),
        (("meshes", 0, "primitives", 2, "mode"), 6),
        (("scenes",), []),
        (("scene",), 3),
    ],
)
def test_gltf_that_is_broken_or_not_read_is_refused(tmp_path, path, value):
    tree, _ = gltf()
    place = tree
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    refused(tmp_path, "a.gltf", json.dumps(tree))


# ---------------------------------------------------------------------------- 3MF


@pytest.mark.parametrize(
    ("unit", "metres"), [('unit="inch"', 0.0254), ('unit="meter"', 1), ("", 0.001)]
)
def test_components_and_units(tmp_path, unit, metres):
    build = '<item objectid="2" transform="2 0 0 0 2 0 0 0 2 0 0 3"/>'
    mesh = load_mesh(save(tmp_path, "a.3mf", threemf(build, unit=unit)))
    turned = np.array([[5, 0, 0], [5, 1, 0], [4, 0, 0]])
    expected = np.stack([2 * TRIANGLE, 2 * turned]) + np.array([0, 0, 3])
    np.testing.assert_allclose(corners(mesh), metres * expected, atol=1e-12)


def test_items_of_one_object_with_one_part_number(tmp_path):
    items = "".join(item(1, x, 'partnumber="LEG-01"') for x in (0, 5, 7))
    mesh = load_mesh(save(tmp_path, "a.3mf", threemf(items)))
    expected = [TRIANGLE + np.array([x, 0, 0]) for x in (0, 5, 7)]
    np.testing.assert_array_equal(corners(mesh), expected)


def test_an_assembly_of_assemblies_is_there_to_its_last_screw(tmp_path):
    """164 instances: trimesh stops at 121 steps."""
    link = '<component objectid="{}" transform="1 0 0 0 1 0 0 0 1 {} 0 0"/>'
    resources = f'<object id="1">{MESH_3MF}</object>' + "".join(
        f'<object id="{name}"><components>'
        + "".join(link.format(name - 1, step * i) for i in range(count))
        + (link.format(1, -1) if name == 3 else "")
        + "</components></object>"
        for name, count, step in ((2, 10, 1), (3, 4, 10), (4, 4, 100))
    )
    mesh = load_mesh(save(tmp_path, "a.3mf", threemf(item(4), resources)))
    found = sorted(corners(mesh)[:, 0, 0])
    expected = [100 * a + 10 * b + c for a in range(4) for b in range(4) for c in range(10)]
    assert found == sorted(expected + [100 * a - 1 for a in range(4)])


@pytest.mark.parametrize("kind", ["support", "solidsupport", "other"])
def test_supports_are_no_furniture(tmp_path, kind):
    more = f'<object id="7" type="{kind}">{MESH_3MF}</object>'
    assembly = '<object id="8"><components><component objectid="7"/></components></object>'
    content = threemf(item(1) + item(7) + item(8), RESOURCES + more + assembly)
    assert len(load_mesh(save(tmp_path, "a.3mf", content)).faces) == 1
    refused(tmp_path, "b.3mf", threemf(item(8), more + assembly))


LOOP = '<object id="2"><components><component objectid="2"/></components></object>'


@pytest.mark.parametrize(
    "content",
    [
        *(b"PK", threemf()[:-30], threemf(name="other.model"), threemf(""), threemf(item(7))),
        *(threemf(resources=LOOP), threemf(unit='unit="ell"')),
        threemf(resources=RESOURCES.replace("component o", 'component p:path="/3D/b" o')),
        threemf(resources=RESOURCES.replace('v3="2"', 'v3="3"')),
        threemf(resources=RESOURCES.replace('x="1"', 'x="one"')),
    ],
)
def test_archives_that_are_broken_or_not_read_are_refused(tmp_path, content):
    refused(tmp_path, "a.3mf", content)


# ---------------------------------------------------------------------------- colliders


@pytest.mark.parametrize(
    ("names", "one"),
    [
        *((("node", name), True) for name in ("Chair_Collider.001", "legs colliders")),
        *((("node", name), True) for name in ("UCX_chair_01", "ubx_a", "a-ConvColOnly_1")),
        *(((name,), False) for name in ("collidercoaster", "a-col", "UCXchair", "a_UCX_b")),
        *(((name, None), False) for name in ("recollision", "", 7)),
    ],
)
def test_names_of_colliders_and_of_others(names, one):
    assert is_collider(*names) is one


@pytest.mark.parametrize("kind", ["glb", "3mf"])
def test_a_scene_with_a_collider_on_disk_and_in_memory(tmp_path, kind):
    scene = trimesh.Scene()
    scene.add_geometry(PYRAMID, node_name="chair", geom_name="chair")
    scene.add_geometry(trimesh.creation.box((9, 9, 9)), node_name="UCX_chair_01")
    path = save(tmp_path, f"a.{kind}", scene.export(file_type=kind))
    plain = save(tmp_path, f"b.{kind}", trimesh.Scene(PYRAMID).export(file_type=kind))
    np.testing.assert_array_equal(corners(load_mesh(path)), corners(load_mesh(plain)))
    for keep in (False, True):
        read = load_mesh(path, keep_colliders=keep)
        assert (len(read.faces), read.colliders) == ((18, 0) if keep else (6, 1))
        for held in (scene, trimesh.load(path)):
            mesh = Mesh.from_trimesh(held, keep_colliders=keep)
            assert (len(mesh.faces), mesh.colliders) == (len(read.faces), read.colliders)


def test_what_hangs_below_a_collider_goes_too_and_a_mesh_may_be_one(tmp_path):
    tree, _ = gltf()
    tree["nodes"][0]["name"] = "all_collider"
    mesh = load_mesh(save_gltf(tmp_path, tree))
    assert (len(mesh.faces), mesh.colliders) == (6, 1)
    tree["meshes"][0]["name"] = "square_collider"
    refused(tmp_path, "b.gltf", json.dumps(tree))
    assert len(load_mesh(tmp_path / "b.gltf", keep_colliders=True).faces) == 12


def test_colliders_of_3mf(tmp_path):
    named = '<object id="{}" name="{}"><components>{}</components></object>'
    links = '<component objectid="1"/>' * 2
    assemblies = named.format(3, "UCX_chair", links) + named.format(4, "b", links)
    build = item(1) + item(3) + item(4, more='partnumber="b_collider"')
    path = save(tmp_path, "a.3mf", threemf(build, RESOURCES + assemblies))
    assert (len(load_mesh(path).faces), load_mesh(path).colliders) == (1, 2)
    assert len(load_mesh(path, keep_colliders=True).faces) == 5
