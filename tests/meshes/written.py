"""Mesh files written for the tests, and what two meshes are compared by."""

import base64
import io
import re
import struct
import zipfile

import numpy as np
import pytest
import trimesh

from qs3.errors import MeshError
from qs3.meshes.io import load_mesh

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


def refused(folder, name, content):
    path = save(folder, name, content)
    with pytest.raises(MeshError, match=re.escape(name)):
        load_mesh(path)


def z_up(mesh):
    turned = mesh.copy()
    turned.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    return turned


def export(name):
    """Bytes of the pyramid in a format of trimesh's, by file name."""
    kind = name.rpartition(".")[2]
    if kind == "3mf":  # trimesh says millimetres, whatever they are
        return PYRAMID.copy().apply_scale(1000).export(file_type=kind)
    if name == "ascii.ply":
        return PYRAMID.export(file_type="ply", encoding="ascii")
    if name == "ascii.stl":
        return PYRAMID.export(file_type="stl_ascii").encode()
    content = PYRAMID.export(file_type=kind)
    return content.encode() if isinstance(content, str) else content


EXPORTS = ["a.off", "a.ply", "ascii.ply", "a.stl", "ascii.stl", "a.obj", "a.glb", "a.3mf"]


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


def gltf(**changes):
    """A square as triangles and two strips, in one mesh, placed by two nodes."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype="<f4")
    indices = np.array([0, 1, 2, 2, 1, 3, 0, 1, 2, 3, 1, 0, 3, 2], dtype="<u2")
    blob = points.tobytes() + indices.tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    points_alone = {"attributes": {"POSITION": 0}}
    triangles = {**points_alone, "indices": 1}
    strips = [{**points_alone, "indices": i, "mode": 5} for i in (2, 3)]
    accessor = {"bufferView": 1, "componentType": 5123, "type": "SCALAR"}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 2]}],
        "nodes": [
            {"children": [1], "translation": [10, 0, 0], "scale": [2, 2, 2]},
            {"mesh": 0, "rotation": [0, 0, 2**-0.5, 2**-0.5]},
            {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 7, 1]},
        ],
        "meshes": [{"primitives": [triangles, *strips, {**points_alone, "mode": 0}]}],
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
        "buffers": [{"byteLength": 76, "uri": uri}],
    }
    return {**tree, **changes}, blob


TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
MESH_3MF = """<mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/>
<vertex x="0" y="1" z="0"/></vertices>
<triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh>"""
RESOURCES = f"""<object id="1" type="model">{MESH_3MF}</object>
<object id="2" type="model"><components><component objectid="1"/>
<component objectid="1" transform="0 1 0 -1 0 0 0 0 1 5 0 0"/></components></object>"""


def item(number, x=0, more=""):
    return f'<item objectid="{number}" {more} transform="1 0 0 0 1 0 0 0 1 {x} 0 0"/>'


PLATE = item(2)


def threemf(items=PLATE, resources=RESOURCES, unit='unit="meter"', name="3D/3dmodel.model"):
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<model {unit} xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
 xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06">
<resources>{resources}</resources><build>{items}</build></model>"""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr(name, text)
    return file.getvalue()


def as_trimesh(mesh):
    """The same triangles in the same order, unprocessed."""
    return trimesh.Trimesh(mesh.vertices.copy(), mesh.faces.copy(), process=False)
