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
