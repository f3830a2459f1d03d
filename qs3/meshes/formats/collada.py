"""COLLADA (.dae): triangles and polygons of the visual scene, in metres, turned to z up.

trimesh needs pycollada for this, and lxml behind it; geometry alone takes little. The XML
parser is Python's own. It opens no external files, and a document type declaration, without
which no entity can be defined, is refused.

https://www.khronos.org/files/collada_spec_1_4.pdf
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree import ElementTree

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.formats.arrays import (
    Y_UP_TO_Z_UP,
    Triangles,
    fan,
    joined,
    numbers,
    transformed,
    used_part,
    whole,
)

_MAX_NODES = 100_000
_NO_SURFACE = ("vertices", "lines", "linestrips")
_TO_Z_UP = {
    "X_UP": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "Y_UP": Y_UP_TO_Z_UP,
    "Z_UP": np.eye(3),
}


def read(data: bytes) -> Triangles:
    """Read all instances of geometry in the scene; skins and other shapes are refused."""
    try:
        root = ElementTree.fromstring(data, ElementTree.XMLParser(target=_NoDoctype()))
    except ElementTree.ParseError as error:
        raise MeshError(f"is truncated or no XML: {error}") from error
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    if root.tag != "COLLADA":
        raise MeshError("is no COLLADA document")
    vertices, faces = joined(_Scene(root).parts())
    unit = root.find("asset/unit")
    metres = float(unit.get("meter", "1")) if unit is not None else 1.0
    up = (root.findtext("asset/up_axis") or "Y_UP").strip()
    return metres * vertices @ _TO_Z_UP[up].T, faces


class _NoDoctype(ElementTree.TreeBuilder):
    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise MeshError("has a document type declaration, which is not read")


class _Scene:
    def __init__(self, root: ElementTree.Element) -> None:
        self.root = root
        self.by_id = {element.get("id"): element for element in root.iter() if element.get("id")}
        self.shapes: dict[ElementTree.Element, Triangles] = {}
        self.positions: dict[ElementTree.Element, np.ndarray] = {}

    def parts(self) -> Iterator[Triangles]:
        """Walk the nodes without recursion; documents may nest and instance at will."""
        instance = self.root.find("scene/instance_visual_scene")
        if instance is None:
            raise MeshError("has no visual scene")
        roots = self._target(instance).findall("node")
        stack = [(node, np.eye(4)) for node in reversed(roots)]
        visited = 0
        while stack:
            visited += 1
            if visited + len(stack) > _MAX_NODES:
                raise MeshError(f"has more than {_MAX_NODES} nodes, or nodes within themselves")
            node, parent = stack.pop()
            matrix = parent @ _transform(node)
            stack += [(child, matrix) for child in node.findall("node")]
            stack += [(self._target(link), matrix) for link in node.findall("instance_node")]
            if node.find("instance_controller") is not None:
                raise MeshError("has a skinned shape, which is not read: export it unskinned")
            for link in node.findall("instance_geometry"):
                yield transformed(self._shape(self._target(link)), matrix)

    def _target(self, link: ElementTree.Element) -> ElementTree.Element:
        url = link.get("url") or link.get("source") or ""
        target = self.by_id.get(url[1:])
        if not url.startswith("#") or target is None:
            raise MeshError(f"refers to {url!r}, which is not in this file")
        return target

    def _shape(self, geometry: ElementTree.Element) -> Triangles:
        if geometry not in self.shapes:
            mesh = geometry.find("mesh")
            if mesh is None:
                raise MeshError("has a shape that is no mesh")
            primitives = [part for part in mesh if part.find("input") is not None]
            self.shapes[geometry] = joined(
                self._primitive(p) for p in primitives if p.tag not in _NO_SURFACE
            )
        return self.shapes[geometry]

    def _primitive(self, primitive: ElementTree.Element) -> Triangles:
        if primitive.tag not in ("triangles", "polylist", "polygons"):
            raise MeshError(f"has {primitive.tag}, which are not read: export triangles")
        if primitive.find("ph") is not None:
            raise MeshError("has polygons with holes, which are not read: export triangles")
        inputs = primitive.findall("input")
        width = 1 + max(int(i.get("offset", "0")) for i in inputs)
        vertex = next(i for i in inputs if i.get("semantic") == "VERTEX")
        lists = [_integers(p.text) for p in primitive.findall("p")]
        indices = np.concatenate([np.zeros(0, dtype=np.int64), *lists])
        corners = indices.reshape(-1, width)[:, int(vertex.get("offset", "0"))]
        if primitive.tag == "triangles":
            sizes = np.full(len(corners) // 3, 3)
        elif primitive.tag == "polylist":
            sizes = _integers(primitive.findtext("vcount"))
        else:
            sizes = np.array([len(p) // width for p in lists], dtype=np.int64)
        if (sizes < 0).any() or sizes.sum() != len(corners):
            raise MeshError("has polygons whose numbers of corners do not add up")
        return used_part(self._positions(self._target(vertex)), fan(sizes, corners))

    def _positions(self, vertices: ElementTree.Element) -> np.ndarray:
        if vertices not in self.positions:
            inputs = vertices.findall("input")
            source = self._target(next(i for i in inputs if i.get("semantic") == "POSITION"))
            accessor = source.find("technique_common/accessor")
            if accessor is None:
                raise MeshError("has positions without an accessor")
            values = numbers((self._target(accessor).text or "").encode())
            count, stride = int(accessor.get("count", "0")), int(accessor.get("stride", "1"))
            start = int(accessor.get("offset", "0"))
            if stride < 3 or count < 0 or start < 0 or start + count * stride > len(values):
                raise MeshError("has fewer coordinates than it promises")
            table = values[start : start + count * stride].reshape(count, stride)
            self.positions[vertices] = table[:, :3]
        return self.positions[vertices]


def _integers(text: str | None) -> np.ndarray:
    return whole(numbers((text or "").encode()), "an index")


def _transform(node: ElementTree.Element) -> np.ndarray:
    """Product of the node's transformations, in the order of the document."""
    matrix = np.eye(4)
    for element in node:
        if element.tag in ("lookat", "skew"):
            raise MeshError(f"has a node with {element.tag}, which is not read")
        if element.tag in ("matrix", "translate", "rotate", "scale"):
            matrix = matrix @ _matrix(element.tag, numbers((element.text or "").encode()))
    return matrix


def _matrix(kind: str, values: np.ndarray) -> np.ndarray:
    if kind == "matrix":
        return values.reshape(4, 4)
    matrix = np.eye(4)
    if kind == "translate":
        matrix[:3, 3] = values
    elif kind == "scale":
        matrix[:3, :3] = np.diag(values)
    else:
        axis, angle = values[:3] / np.linalg.norm(values[:3]), np.deg2rad(values[3])
        cross = np.cross(axis, np.eye(3)).T  # cross @ v = axis x v
        matrix[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return matrix
