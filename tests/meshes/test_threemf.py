"""3MF: units, components, and archives that mean harm."""

import io
import zipfile

import numpy as np
import pytest

from qs3.meshes.formats.by_trimesh import assembled, loaded
from qs3.meshes.io import load_mesh
from tests.meshes.written import corners, refused, save

MESH = """<mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/>
<vertex x="0" y="1" z="0"/></vertices>
<triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh>"""
RESOURCES = f"""<object id="1" type="model">{MESH}</object>
<object id="2" type="model"><components><component objectid="1"/>
<component objectid="1" transform="0 1 0 -1 0 0 0 0 1 5 0 0"/></components></object>"""
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def model(resources=RESOURCES, item="2", head="", unit='unit="inch"'):
    return f"""<?xml version="1.0" encoding="UTF-8"?>{head}
<model {unit} xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
 xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06">
<resources>{resources}</resources>
<build><item objectid="{item}" transform="2 0 0 0 2 0 0 0 2 0 0 3"/></build></model>"""


def archive(text, name="3D/3dmodel.model"):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr(name, text)
    return file.getvalue()


@pytest.mark.parametrize(
    ("unit", "metres"), [('unit="inch"', 0.0254), ('unit="meter"', 1), ("", 0.001)]
)
def test_components_and_units(tmp_path, unit, metres):
    mesh = load_mesh(save(tmp_path, "a.3mf", archive(model(unit=unit))))
    turned = np.array([[5, 0, 0], [5, 1, 0], [4, 0, 0]])
    expected = np.stack([2 * TRIANGLE, 2 * turned]) + np.array([0, 0, 3])
    np.testing.assert_allclose(corners(mesh), metres * expected, atol=1e-12)


NESTED = RESOURCES + "".join(
    f'<object id="{i}"><components><component objectid="{i - 1}"/><component objectid="{i - 1}"/>'
    "</components></object>"
    for i in range(3, 40)
)
LOOP = '<object id="2"><components><component objectid="2"/></components></object>'


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"PK", "not a 3MF"),
        (archive(model())[:-30], "truncated"),
        (archive(model(), "other.model"), "holds no 3D"),
        (archive(model(NESTED, "39")), "more than 100000 parts"),
        (archive(model(LOOP)), "within themselves"),
        (archive(model(head='<!DOCTYPE x [<!ENTITY a "b">]>')), "document type"),
        (archive(model(RESOURCES.replace("component o", 'component p:path="/3D/b" o'))), "several"),
        (archive(model(unit='unit="ell"')), "unknown unit 'ell'"),
        (archive(model(RESOURCES.replace('v3="2"', 'v3="3"'))), "not among 3"),
        (archive(model(RESOURCES.replace('x="1"', 'x="one"'))), "3MF"),
        (archive(model(item="7")), "object '7', which is not in"),
        (archive(model()[:-20]), "3MF"),
    ],
)
def test_broken_archives_are_refused_with_the_reason(tmp_path, content, reason):
    refused(tmp_path, "a.3mf", content, reason)


def test_archives_that_unpack_to_too_much(tmp_path, monkeypatch):
    monkeypatch.setenv("QS3_MEMORY_GB", "0.0002")
    refused(tmp_path, "a.3mf", archive(model() + " " * 20_000), "GB of memory, more than 0.0002")


def placed(x, more=""):
    return f'<item objectid="1" {more} transform="1 0 0 0 1 0 0 0 1 {x} 0 0"/>'


def with_items(items, resources=RESOURCES):
    text = model(resources, unit='unit="meter"')
    return archive(text[: text.index("<build>")] + f"<build>{items}</build></model>")


def test_items_of_one_object_with_one_part_number(tmp_path):
    items = "".join(placed(x, 'partnumber="LEG-01"') for x in (0, 5, 7))
    mesh = load_mesh(save(tmp_path, "a.3mf", with_items(items)))
    expected = [TRIANGLE + np.array([x, 0, 0]) for x in (0, 7, 5)]  # as without the number
    np.testing.assert_array_equal(corners(mesh), expected)


def test_an_assembly_of_assemblies_is_there_to_its_last_screw(tmp_path):
    """164 instances: trimesh stops at 121 steps."""
    link = '<component objectid="{}" transform="1 0 0 0 1 0 0 0 1 {} 0 0"/>'
    resources = f'<object id="1">{MESH}</object>' + "".join(
        f'<object id="{name}"><components>'
        + "".join(link.format(name - 1, step * i) for i in range(count))
        + (link.format(1, -1) if name == 3 else "")
        + "</components></object>"
        for name, count, step in ((2, 10, 1), (3, 4, 10), (4, 4, 100))
    )
    mesh = load_mesh(save(tmp_path, "a.3mf", with_items('<item objectid="4"/>', resources)))
    found = sorted(corners(mesh)[:, 0, 0])
    expected = [100 * a + 10 * b + c for a in range(4) for b in range(4) for c in range(10)]
    assert found == sorted(expected + [100 * a - 1 for a in range(4)])


def test_instances_stand_in_the_order_of_trimesh(tmp_path):
    """Without part numbers and deep nesting, which it misreads, to the bit."""
    turn = 'transform="0.36 0.48 -0.8 -0.8 0.6 0 0.48 0.64 0.6 0.1 0.2 0.3"'
    resources = RESOURCES + (
        f'<object id="3"><components><component objectid="2" {turn}/><component objectid="1"/>'
        f'<component objectid="2"/><component objectid="1" {turn}/></components></object>'
        f'<object id="4"><components><component objectid="3" {turn}/></components></object>'
    )
    items = f'{placed(1)}<item objectid="4" {turn}/>{placed(2)}<item objectid="3"/>{placed(3)}'
    content = with_items(items, resources)
    mesh = load_mesh(save(tmp_path, "a.3mf", content))
    vertices, faces = assembled(loaded("3mf", content, postprocess=False))
    np.testing.assert_array_equal(corners(mesh), vertices[faces])
    assert len(faces) == 15


@pytest.mark.parametrize("kind", ["support", "solidsupport", "other"])
def test_supports_are_no_furniture(tmp_path, caplog, kind):
    more = f'<object id="7" type="{kind}">{MESH}</object>'
    assembly = '<object id="8"><components><component objectid="7"/></components></object>'
    items = placed(0) + '<item objectid="7"/><item objectid="8"/>'
    path = save(tmp_path, "a.3mf", with_items(items, RESOURCES + more + assembly))
    assert len(load_mesh(path).faces) == 1
    assert f"{path}: 2 objects are left out as no part of the model" in caplog.text
    refused(tmp_path, "b.3mf", with_items('<item objectid="8"/>', more + assembly), "no faces")


def test_an_object_or_a_plate_with_nothing_on_it(tmp_path):
    refused(tmp_path, "a.3mf", with_items(""), "no items on its build plate")
    empty = '<object id="1"><components/></object>'
    refused(tmp_path, "b.3mf", with_items(placed(0), empty), "object '1' without a mesh")
