"""Nodes that nobody sees: left out, counted, kept on demand."""

import json

import numpy as np
import pytest
import trimesh

from qs3.errors import MeshError
from qs3.meshes.formats.colliders import Colliders
from qs3.meshes.io import load_mesh
from qs3.meshes.mesh import Mesh
from tests.meshes.test_threemf import RESOURCES, with_items
from tests.meshes.written import PYRAMID, corners, dae, gltf, refused, save


@pytest.mark.parametrize(
    "name",
    [
        *("chair_collider", "Chair_Collider.001", "COLLIDER", "leg-collision_2", "legs colliders"),
        *("UCX_chair_01", "ubx_a", "UCP_a", "USP_a", "MCDCX_a", "a-colonly", "a-ConvColOnly_1"),
    ],
)
def test_names_of_colliders(name):
    colliders = Colliders()
    assert colliders.left_out("node", name)
    assert colliders.left_out(name, None)
    assert colliders.count == 2
    assert not Colliders(skip=False).left_out(name)


@pytest.mark.parametrize(
    "name", ["collidercoaster", "a-col", "UCXchair", "a_UCX_b", "recollision", "collider_of", "", 7]
)
def test_names_of_others(name):
    assert not Colliders().left_out(name, None)


@pytest.mark.parametrize("kind", ["glb", "3mf"])
def test_a_scene_with_a_collider(tmp_path, kind):
    scene = trimesh.Scene()
    scene.add_geometry(PYRAMID, node_name="chair", geom_name="chair")
    hull = trimesh.creation.box((9, 9, 9))
    scene.add_geometry(hull, node_name="Chair_Collider", geom_name="hull_collider")
    path = save(tmp_path, f"a.{kind}", scene.export(file_type=kind))
    plain = save(tmp_path, f"b.{kind}", trimesh.Scene(PYRAMID).export(file_type=kind))
    seen, kept = load_mesh(path), load_mesh(path, keep_colliders=True)
    np.testing.assert_array_equal(corners(seen), corners(load_mesh(plain)))
    assert (seen.colliders, kept.colliders, load_mesh(plain).colliders) == (1, 0, 0)
    assert len(kept.faces) == len(PYRAMID.faces) + 12
    np.testing.assert_array_equal(corners(kept)[: len(seen.faces)], corners(seen))


def test_what_hangs_below_a_collider_goes_too_and_a_mesh_may_be_one(tmp_path):
    tree, _ = gltf()
    tree["nodes"][0]["name"] = "all_collider"
    path = save(tmp_path, "a.gltf", json.dumps(tree))
    assert (len(load_mesh(path).faces), load_mesh(path).colliders) == (6, 1)
    tree["meshes"][0]["name"] = "square_collider"
    path = save(tmp_path, "b.gltf", json.dumps(tree))
    refused(tmp_path, "b.gltf", json.dumps(tree), "no faces but in 2 colliders.*colliders=keep")
    assert len(load_mesh(path, keep_colliders=True).faces) == 12


def test_collada(tmp_path):
    square = '<instance_geometry url="#g"/>'
    nodes = f'<node>{square}<node name="UCX_a">{square}<node>{square}</node></node></node>'
    path = save(tmp_path, "a.dae", dae(nodes=nodes))
    assert (len(load_mesh(path).faces), load_mesh(path).colliders) == (2, 1)
    assert len(load_mesh(path, keep_colliders=True).faces) == 6


def test_a_geometry_of_collada_may_be_one(tmp_path):
    """It hides its instances, and not what hangs below them, as in glTF."""
    tree = dae(nodes='<node><instance_geometry url="#g"/><node name="leg"/></node>')
    refused(tmp_path, "a.dae", tree.replace('"g">', '"g" name="UCX_seat">'), "in 1 collider")
    shape = tree[tree.index("<geometry") : tree.index("</library_geometries>")]
    hull = shape.replace('"g">', '"h" name="UCX_seat">')
    for name in ("p", "pa", "v"):
        hull = hull.replace(f'"{name}"', f'"h{name}"').replace(f'"#{name}"', f'"#h{name}"')
    nodes = '<node><instance_geometry url="#h"/><node><instance_geometry url="#g"/></node></node>'
    tree = dae(nodes=nodes).replace(shape, shape + hull)
    path = save(tmp_path, "b.dae", tree)
    assert (len(load_mesh(path).faces), load_mesh(path).colliders) == (2, 1)
    assert len(load_mesh(path, keep_colliders=True).faces) == 4


def test_3mf_assemblies_and_part_numbers(tmp_path):
    """What hangs below a collider goes with it, and is counted once."""
    named = '<object id="{}" name="{}"><components>{}</components></object>'
    links = '<component objectid="1"/>' * 2
    assemblies = named.format(3, "UCX_chair", links) + named.format(4, "b", links)
    content = with_items(
        '<item objectid="1"/><item objectid="3"/><item objectid="4" partnumber="b_collider"/>',
        RESOURCES + assemblies,
    )
    path = save(tmp_path, "a.3mf", content)
    assert (len(load_mesh(path).faces), load_mesh(path).colliders) == (1, 2)
    assert len(load_mesh(path, keep_colliders=True).faces) == 5


@pytest.mark.parametrize("kind", ["glb", "3mf"])
def test_a_scene_in_memory_goes_by_the_same_rule(tmp_path, kind):
    scene = trimesh.Scene()
    scene.add_geometry(PYRAMID, node_name="chair", geom_name="chair")
    scene.add_geometry(trimesh.creation.box((9, 9, 9)), node_name="UCX_chair_01")
    path = save(tmp_path, f"a.{kind}", scene.export(file_type=kind))
    for keep in (False, True):
        read = load_mesh(path, keep_colliders=keep)
        for held in (scene, trimesh.load(path)):
            mesh = Mesh.from_trimesh(held, keep_colliders=keep)
            assert (len(mesh.faces), mesh.colliders) == (len(read.faces), read.colliders)
    assert len(mesh.faces) == len(PYRAMID.faces) + 12
    alone = trimesh.Scene(PYRAMID)
    np.testing.assert_allclose(corners(Mesh.from_trimesh(scene)), corners(PYRAMID))
    assert Mesh.from_trimesh(alone).colliders == 0


def test_below_a_node_in_memory():
    """All of it goes and is counted once; below a mesh of such a name the rest stays."""

    def held(node, mesh):
        scene = trimesh.Scene()
        scene.add_geometry(PYRAMID, node_name="chair", geom_name="chair")
        scene.add_geometry(PYRAMID, node_name=node, geom_name=mesh)
        scene.add_geometry(PYRAMID, node_name="b", geom_name="leg", parent_node_name=node)
        scene.add_geometry(PYRAMID, node_name=7, geom_name="foot", parent_node_name="b")
        scene.add_geometry(PYRAMID, node_name="c_collider", geom_name="c", parent_node_name="b")
        return scene

    found = {
        (node, mesh): Mesh.from_trimesh(held(node, mesh))
        for node, mesh in [("a_collider", "a"), ("a", "a_collision"), ("a", "a")]
    }
    parts = [(len(m.faces) / len(PYRAMID.faces), m.colliders) for m in found.values()]
    assert parts == [(1, 1), (3, 2), (4, 1)]


def test_nothing_but_colliders_in_memory():
    scene = trimesh.Scene({"a_collider": PYRAMID})
    with pytest.raises(MeshError, match=r"no faces but in 1 collider, which is.*colliders=keep"):
        Mesh.from_trimesh(scene)
    assert len(Mesh.from_trimesh(scene, keep_colliders=True).faces) == len(PYRAMID.faces)
    assert len(Mesh.from_trimesh(PYRAMID).faces) == len(PYRAMID.faces)
