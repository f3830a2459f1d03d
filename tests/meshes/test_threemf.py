"""3MF: units, components, and archives that mean harm."""

import io
import zipfile

import numpy as np
import pytest

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
