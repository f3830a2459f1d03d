"""COLLADA: primitives, axes, transforms, and files that mean harm."""

import numpy as np
import pytest

from qs3.meshes.io import load_mesh
from tests.meshes.written import PRIMITIVES, TRIANGLES, corners, dae, refused, save


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_collada_primitives(tmp_path, kind):
    mesh = load_mesh(save(tmp_path, "a.dae", dae(PRIMITIVES[kind])))
    square = np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0]])
    assert corners(mesh).tolist() == square[[[0, 1, 2], [0, 2, 3]]].tolist()


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
    # each square's corners are 0, 1, 2 and 0, 2, 3; the inner node comes first
    inner, here = (mesh.vertices * 2).reshape(2, 6, 3)
    np.testing.assert_allclose(here[[1, 5]], [[10, 2, 0], [6, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(inner[[1, 5]], [[10, 4, 3], [6, 2, 3]], atol=1e-6)


def test_a_scene_a_node_and_a_geometry_may_share_an_id(tmp_path):
    """As 132 of 140 sound files of a collection do."""
    nodes = '<node id="s"><instance_geometry url="#s"/><instance_node url="#g"/></node>'
    content = dae(nodes=nodes).replace('geometry id="g"', 'geometry id="s"')
    content = content.replace('<node id="n"><instance_geometry url="#g"/>', LIBRARY_NODE)
    mesh = load_mesh(save(tmp_path, "a.dae", content))
    assert corners(mesh)[:, :, 2].tolist() == [[0, 0, 0]] * 2 + [[1, 1, 1]] * 2


def test_what_pycollada_would_misread(tmp_path):
    """Two lists of triangles, a polygon of two corners, normals that do not exist, a camera."""
    plain = corners(load_mesh(save(tmp_path, "a.dae", dae()))).tolist()
    two = TRIANGLES.replace(" 0 9 2 9 3 9", "</p><p>0 9 2 9 3 9")
    thin = PRIMITIVES["polylist"].replace("<vcount>4<", "<vcount>2 4 1<")
    thin = thin.replace("<p>", "<p>7 1 7 3 ").replace("</p>", " 7 2</p>")
    camera = '<node><lookat>1</lookat><instance_camera url="#gone"/></node>'
    bare = '<polygons count="0"><input semantic="VERTEX" source="#v" offset="0"/></polygons>'
    for content in (
        dae(two),
        dae(thin),
        dae(TRIANGLES + bare),
        dae(TRIANGLES.replace('NORMAL" source="#v"', 'NORMAL" source="#gone"')),
        dae(nodes=camera + '<node><instance_geometry url="#g"/></node>'),
    ):
        assert corners(load_mesh(save(tmp_path, "a.dae", content))).tolist() == plain
    refused(tmp_path, "a.dae", dae().replace("1 1 0 0", "1 nan 0 0"), "not finite")


def test_nodes_unfolded_without_end(tmp_path):
    """2^40 instances of a square, by forty nodes that hold the next one twice."""
    twice = "".join(
        f'<node id="n{i}">' + f'<instance_node url="#n{i + 1}"/>' * 2 + "</node>" for i in range(40)
    )
    content = dae(nodes='<node><instance_node url="#n0"/></node>').replace(
        "<library_nodes>", f'<library_nodes>{twice}<node id="n40"/>'
    )
    refused(tmp_path, "a.dae", content, "more than 100000 parts")


LIBRARY_NODE = '<node id="g"><translate>0 0 2</translate><instance_geometry url="#s"/>'
LOOKAT = '<node><lookat>1</lookat><instance_geometry url="#g"/></node>'
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
        (dae(nodes=LOOKAT), "lookat"),
        (dae(TRIANGLES.replace("3 9<", "4 9<")), "beyond the limits"),
        (dae(TRIANGLES.replace("3 9<", "-1 9<")), "negative vertex"),
        (dae(TRIANGLES.replace(" 3 9<", "<")), "add up|COLLADA|DAE"),
        (dae(TRIANGLES.replace("triangles", "tristrips")), "tristrips"),
        (dae().replace('count="4"', 'count="40"'), "fewer coordinates"),
        ("<COLLADA/>", "no visual scene"),
        ("<html/>", "not a COLLADA"),
        ("hello", "not XML"),
    ],
)
def test_broken_collada_is_refused_with_the_reason(tmp_path, content, reason):
    refused(tmp_path, "a.dae", content, reason)
