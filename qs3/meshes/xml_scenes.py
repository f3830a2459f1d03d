"""COLLADA (.dae) and 3MF: the triangles of the scene, or of the build plate, in metres, z up.

They are XML, and read here: trimesh 5.2 loses COLLADA's names of nodes and the axis that is up,
skips accessors' offsets and all but the first list of triangles, and cuts concave polygons wrongly;
it puts 3MF items of one object with one part number in one place, and loses instances of deeply
nested assemblies. All that silently.

https://www.khronos.org/files/collada_spec_1_4.pdf, https://github.com/3MFConsortium/spec_core
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from xml.etree import ElementTree

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.mesh import Y_UP_TO_Z_UP, Colliders, used_part
from qs3.meshes.polygons import Triangles, joined, numbers, triangulated, whole

Element = ElementTree.Element

_TO_Z_UP = {
    "X_UP": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "Y_UP": Y_UP_TO_Z_UP,
    "Z_UP": np.eye(3),
}
_METRES = {
    **{"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "meter": 1.0},
    **{"inch": 0.0254, "foot": 0.3048},
}
_NO_PART = ("support", "solidsupport", "other")
"""Types of 3MF's objects that support the model while it is printed, or help otherwise."""


def read_collada(data: bytes, colliders: Colliders) -> Triangles:
    """Read all instances of geometry in the scene."""
    root = _parsed(data)
    unit = root.find("asset/unit")
    metres = float(unit.get("meter", "1")) if unit is not None else 1.0
    up = _TO_Z_UP[(root.findtext("asset/up_axis") or "Y_UP").strip()]
    vertices, faces = joined(_Collada(root, colliders).parts())
    return metres * vertices @ up.T, faces


class _Collada:
    """A reference is looked up among elements of its kind: a scene and a node may have one id."""

    def __init__(self, root: Element, colliders: Colliders) -> None:
        self.colliders = colliders
        self.start = root.find("scene/instance_visual_scene").attrib["url"]  # type: ignore[union-attr]
        self.known = {
            tag: {f"#{element.get('id')}": element for element in root.iter(tag)}
            for tag in ("node", "geometry", "visual_scene")
        }

    def parts(self) -> Iterator[Triangles]:
        """The surfaces of the scene, in the order of the file."""
        yield from self._below(self.known["visual_scene"][self.start], np.eye(4))

    def _below(self, node: Element, world: np.ndarray) -> Iterator[Triangles]:
        """The surfaces of a node [4, 4] in the world, and of those within it."""
        places = any(node.find(f".//instance_{kind}") is not None for kind in ("geometry", "node"))
        for child in node:
            if child.tag in ("translate", "rotate", "scale", "matrix"):
                world = world @ _transform(child)
            elif child.tag == "instance_controller" or (
                child.tag in ("lookat", "skew") and places  # those of a camera do not matter
            ):
                raise MeshError(f"has a node with {child.tag}, which is not read")
        for child in node:
            if child.tag in ("node", "instance_node"):
                inner = child if child.tag == "node" else self.known["node"][child.attrib["url"]]
                if not self.colliders.left_out(inner.get("name"), inner.get("id")):
                    yield from self._below(inner, world)
            elif child.tag == "instance_geometry":
                geometry = self.known["geometry"][child.attrib["url"]]
                if not self.colliders.left_out(geometry.get("name"), geometry.get("id")):
                    yield from ((v @ world[:3, :3].T + world[:3, 3], f) for v, f in _mesh(geometry))


def _transform(element: Element) -> np.ndarray:
    """[4, 4] of one element of a node."""
    import trimesh

    values, matrix = numbers(element.text), np.eye(4)
    if element.tag == "matrix":
        return values.reshape(4, 4)
    if element.tag == "rotate":  # an axis, and degrees
        turn: np.ndarray = trimesh.transformations.rotation_matrix(
            np.deg2rad(values[3]), values[:3]
        )
        return turn
    if element.tag == "scale":
        return np.diag([*values, 1.0])
    matrix[:3, 3] = values
    return matrix


def _mesh(geometry: Element) -> Iterator[Triangles]:
    """The surfaces of a geometry, with three vertices a triangle."""
    mesh = geometry.find("mesh")
    assert mesh is not None, "has a shape that is not a mesh"
    sources = {f"#{source.get('id')}": source for source in mesh.findall("source")}
    positions = {
        f"#{vertices.get('id')}": _positions(sources[put.get("source", "")])
        for vertices in mesh.findall("vertices")
        for put in vertices
        if put.get("semantic") == "POSITION"
    }
    for primitive in mesh:
        if primitive.tag in ("triangles", "polylist", "polygons"):
            soup = _primitive(primitive, positions).reshape(-1, 3)
            yield soup, np.arange(len(soup)).reshape(-1, 3)
        elif primitive.tag in ("tristrips", "trifans"):
            raise MeshError(f"has {primitive.tag}, which are not read: export triangles")


def _positions(source: Element) -> np.ndarray:
    """[V, 3]; of single precision, as COLLADA's floats are."""
    accessor = source.find("technique_common/accessor")
    assert accessor is not None
    values = numbers(source.findtext("float_array")).astype(np.float32)
    start, stride = int(accessor.get("offset", "0")), int(accessor.get("stride", "1"))
    rows = values[start : start + int(accessor.get("count", "0")) * stride]
    return rows.reshape(int(accessor.get("count", "0")), stride)[:, :3].astype(np.float64)


def _primitive(primitive: Element, positions: dict[str, np.ndarray]) -> np.ndarray:
    """[F, 3, 3] corners of the polygons of one element, cut into triangles."""
    inputs = primitive.findall("input")
    vertex = next(put for put in inputs if put.get("semantic") == "VERTEX")
    width = 1 + max(int(put.get("offset", "0")) for put in inputs)
    vertices = positions[vertex.get("source", "")]
    if primitive.find("ph") is not None:
        raise MeshError("has polygons with holes, which are not read: export triangles")
    lists = [
        whole(numbers(p.text)).reshape(-1, width)[:, int(vertex.get("offset", "0"))]
        for p in primitive.findall("p")
    ]
    corners = np.concatenate([np.zeros(0, np.int64), *lists])
    sizes = np.array([len(some) for some in lists], np.int64)
    if primitive.tag == "polylist":
        sizes = whole(numbers(primitive.findtext("vcount")))
    elif primitive.tag == "triangles":
        sizes = np.full(len(corners) // 3, 3)
    if sizes.sum() != len(corners) or corners.min(initial=0) < 0:
        raise MeshError("has polygons whose corners do not add up, or are negative")
    return vertices[triangulated(vertices, sizes, corners)]


def read_3mf(data: bytes, colliders: Colliders) -> Triangles:
    """Read the model; one that is spread over several files of the archive is refused."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        (name,) = [n for n in archive.namelist() if "3d/3dmodel.model" in n.lower()]
        root = _parsed(archive.read(name))
    vertices, faces = joined(_plate(root, colliders))
    return _METRES[root.get("unit", "millimeter")] * vertices, faces


def _plate(root: Element, colliders: Colliders) -> Iterator[Triangles]:
    """All instances of meshes, put into the world, in the order of the file."""
    objects = {element.get("id", ""): element for element in root.iter("object")}
    meshes = {name: _triangles(element) for name, element in objects.items()}
    helpers = 0

    def below(links: list[Element], above: np.ndarray) -> Iterator[Triangles]:
        nonlocal helpers
        for link in links:
            if any(key.endswith("}path") for key in link.attrib):
                raise MeshError("is spread over several files, which is not read: export one model")
            element = objects[link.get("objectid", "")]
            if element.get("type", "model") in _NO_PART:
                helpers += 1
            elif not colliders.left_out(element.get("name"), link.get("partnumber")):
                matrix = above @ _matrix(link.get("transform"))
                if mesh := meshes[element.get("id", "")]:
                    yield mesh[0] @ matrix[:3, :3].T + matrix[:3, 3], mesh[1]
                yield from below(element.findall("components/component"), matrix)

    yield from below(root.findall("build/item"), np.eye(4))
    if helpers:
        colliders.notes.append(f"{helpers} objects for printing ({', '.join(_NO_PART)}) left out")


def _triangles(element: Element) -> Triangles | None:
    """The mesh of an object, with the vertices that it uses; None if it has none."""
    vertices = [[v.get(axis, "") for axis in "xyz"] for v in element.iter("vertex")]
    corners = [[t.get(key, "") for key in ("v1", "v2", "v3")] for t in element.iter("triangle")]
    if not corners:
        return None
    return used_part(np.array(vertices, dtype=np.float64), np.array(corners, dtype=np.int64))


def _matrix(text: str | None) -> np.ndarray:
    """[4, 4] of 3MF's twelve numbers: a row for each axis, and the translation."""
    matrix = np.eye(4)
    if text is not None:
        matrix[:3] = numbers(text).reshape(4, 3).T
    return matrix


def _parsed(data: bytes) -> Element:
    """The document's root; tags without their namespaces."""
    root = ElementTree.fromstring(data)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    return root
