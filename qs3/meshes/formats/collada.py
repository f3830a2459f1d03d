"""COLLADA (.dae), by trimesh and pycollada: triangles and polygons of the scene, metres, z up.

They are given the scene's surfaces and nothing else, since from a whole file they lose the names
of nodes and the axis that is up; skip accessors' offsets, polygons of two corners, NaN, and all
but the first list of triangles; and refuse sound shapes for normals or materials that are not.

The XML is parsed here first, by Python's own parser, which opens no other file; a document type
declaration, without which no entity can be defined, is refused. pycollada keeps float32.

https://www.khronos.org/files/collada_spec_1_4.pdf
"""

from __future__ import annotations

import io
import zipfile
from itertools import compress
from xml.etree import ElementTree

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.formats.arrays import Y_UP_TO_Z_UP, Triangles, fan, numbers, whole
from qs3.meshes.formats.by_trimesh import assembled, check_instances, loaded
from qs3.meshes.formats.colliders import Colliders
from qs3.meshes.formats.polygons import triangulated

Element = ElementTree.Element

_NAMESPACE = "http://www.collada.org/2005/11/COLLADASchema"
_PLACES = ("node", "matrix", "translate", "rotate", "scale", "instance_geometry")
_NO_SURFACE = ("vertices", "lines", "linestrips", "extra")
_TO_Z_UP = {
    "X_UP": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "Y_UP": Y_UP_TO_Z_UP,
    "Z_UP": np.eye(3),
}


def read(data: bytes, colliders: Colliders) -> Triangles:
    """Read all instances of geometry in the scene; skins and other shapes are refused."""
    if zipfile.is_zipfile(io.BytesIO(data)):  # pycollada would read what is inside
        raise MeshError("is an archive: unpack it")
    try:
        root = ElementTree.fromstring(data, ElementTree.XMLParser(target=_NoDoctype()))
    except ElementTree.ParseError as error:
        raise MeshError(f"is truncated or not XML: {error}") from error
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    if root.tag != "COLLADA":
        raise MeshError("is not a COLLADA document")
    unit = root.find("asset/unit")
    metres = float(unit.get("meter", "1")) if unit is not None else 1.0
    up = _TO_Z_UP[(root.findtext("asset/up_axis") or "Y_UP").strip()]
    _prepare(root, colliders)
    found = loaded("dae", ElementTree.tostring(root), ignore_broken=False)
    vertices, faces = assembled(found)
    return metres * vertices @ up.T, faces


class _NoDoctype(ElementTree.TreeBuilder):
    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise MeshError("has a document type declaration, which is not read")


def _prepare(root: Element, colliders: Colliders) -> None:
    """Leave the scene and its geometry, with instances of nodes put where they are instanced.

    A reference is looked up among elements of its kind: in many files a scene and a node, or a
    node and a geometry, have one id.
    """
    nodes, geometries, scenes = (
        {f"#{element.get('id')}": element for element in root.iter(tag)}
        for tag in ("node", "geometry", "visual_scene")
    )
    start = root.find("scene/instance_visual_scene")
    if start is None:
        raise MeshError("has no visual scene")
    scene = _target(start, scenes)
    used: dict[str, Element] = {}
    parts: dict[str, list[str]] = {}
    waiting = [scene]
    while waiting:
        element = waiting.pop()
        if str(id(element)) in parts:
            continue
        if element is not scene:
            _prepare_node(element, nodes, colliders)
        for link in element.findall("instance_geometry"):
            geometry = _target(link, geometries)
            if colliders.left_out(geometry.get("name"), geometry.get("id")):
                element.remove(link)
                continue
            used[link.get("url", "")] = geometry
            link[:] = []  # materials
        inner = element.findall("node")
        parts[str(id(element))] = [str(id(child)) for child in inner]
        waiting += inner
    check_instances(parts, str(id(scene)))
    library, shown = Element("library_geometries"), Element("library_visual_scenes")
    for geometry in used.values():
        mesh = geometry.find("mesh")
        if mesh is None:
            raise MeshError("has a shape that is not a mesh")
        _prepare_mesh(mesh)
        geometry[:] = [mesh]
        library.append(geometry)
    shown.append(scene)
    default = Element("scene")
    default.append(start)
    root[:] = [library, shown, default]
    root.set("xmlns", _NAMESPACE)


def _target(link: Element, among: dict[str, Element]) -> Element:
    url = link.get("url") or link.get("source") or ""
    if url not in among:
        raise MeshError(f"refers to {url!r}, which is not in this file")
    return among[url]


def _prepare_node(node: Element, nodes: dict[str, Element], colliders: Colliders) -> None:
    """Leave what places surfaces; of a collider, nothing."""
    if colliders.left_out(node.get("name"), node.get("id")):
        node[:] = []
        return
    if node.find("instance_controller") is not None:
        raise MeshError("has a skinned shape, which is not read: export it unskinned")
    kept = []
    for child in node:
        if child.tag in ("lookat", "skew") and not _is_empty(node):
            raise MeshError(f"has a node with {child.tag}, which is not read")
        if child.tag == "instance_node":
            kept.append(_target(child, nodes))
        elif child.tag in _PLACES:
            kept.append(child)
    node[:] = kept


def _is_empty(node: Element) -> bool:
    """Whether it places nothing: a camera or a light."""
    return all(node.find(f".//instance_{kind}") is None for kind in ("geometry", "node"))


def _prepare_mesh(mesh: Element) -> None:
    """Leave positions and polygons, written as pycollada reads them."""
    sources = {source.get("id"): source for source in mesh.findall("source")}
    kept = []
    positions: dict[str, Element] = {}  # by what primitives call them
    for vertices in mesh.findall("vertices"):
        vertices[:] = [put for put in vertices if put.get("semantic") == "POSITION"]
        source = sources[vertices[0].get("source", "")[1:]]
        _prepare_positions(source)
        positions[f"#{vertices.get('id')}"] = source
        kept += [source, vertices]
    for primitive in mesh:
        if primitive.tag not in _NO_SURFACE and primitive.find("input") is not None:
            made = _prepare_primitive(primitive, str(kept[0].get("id")))
            for some in made:
                _cut_concave(some, positions)
            kept += made
    mesh[:] = kept


def _prepare_positions(source: Element) -> None:
    values, accessor = source.find("float_array"), source.find("technique_common/accessor")
    if values is None or accessor is None:
        raise MeshError("has positions without an accessor")
    text = values.text or ""
    if "n" in text.lower():  # nan or inf; pycollada makes zeros of the one
        raise MeshError("has a coordinate that is not finite")
    tokens = text.split()
    count, stride = int(accessor.get("count", "0")), int(accessor.get("stride", "1"))
    start = int(accessor.get("offset", "0"))
    end = start + count * stride
    if stride < 3 or count < 0 or start < 0 or end > len(tokens):
        raise MeshError("has fewer coordinates than it promises")
    if (stride, start, end) != (3, 0, len(tokens)):
        rows = range(start, end, stride)
        values.text = " ".join(token for row in rows for token in tokens[row : row + 3])
    accessor[:] = [Element("param", name=axis, type="float") for axis in "XYZ"]


def _prepare_primitive(primitive: Element, positions: str) -> list[Element]:
    """The polygons, in a list, with nothing but positions; an empty list where there are none."""
    if primitive.tag not in ("triangles", "polylist", "polygons"):
        raise MeshError(f"has {primitive.tag}, which are not read: export triangles")
    if primitive.find("ph") is not None:
        raise MeshError("has polygons with holes, which are not read: export triangles")
    inputs, lists = primitive.findall("input"), primitive.findall("p")
    for put in inputs:
        if put.get("semantic") != "VERTEX":  # its column remains, but nobody looks at it
            put.attrib.update(semantic="TANGENT", source=f"#{positions}")
        put.set("offset", put.get("offset", "0"))
    width = 1 + max(int(put.get("offset", "0")) for put in inputs)
    corners = [(p.text or "").split() for p in lists]
    if any("-" in (p.text or "") for p in lists):
        raise MeshError(
            "has a face with a negative vertex"
        )  # pycollada would count it from the end
    if primitive.tag == "polygons":
        corners = [some for some in corners if len(some) >= 3 * width]
        sizes = [len(some) // width for some in corners]
    else:
        corners = [[token for some in corners for token in some]]
        sizes = [int(size) for size in (primitive.findtext("vcount") or "").split()]
        if primitive.tag == "triangles":
            sizes = [3] * (len(corners[0]) // (3 * width))
        if min(sizes, default=0) < 0 or sum(sizes) * width != len(corners[0]):
            raise MeshError("has polygons whose numbers of corners do not add up")
        if min(sizes, default=3) < 3:
            places = [size >= 3 for size in sizes for _ in range(size * width)]
            corners = [list(compress(corners[0], places))]
            sizes = [size for size in sizes if size >= 3]
    primitive[:] = inputs
    if primitive.tag == "polylist":
        ElementTree.SubElement(primitive, "vcount").text = " ".join(map(str, sizes))
    for some in corners:
        ElementTree.SubElement(primitive, "p").text = " ".join(some)
    return [primitive] if sizes else []


def _cut_concave(primitive: Element, positions: dict[str, Element]) -> None:
    """Make triangles of polygons that pycollada, which cuts them as fans, would cut wrongly.

    Where they hold what is not there they stay as they are, and pycollada says it.
    """
    if primitive.tag == "triangles":
        return
    inputs = primitive.findall("input")
    vertex = next(put for put in inputs if put.get("semantic") == "VERTEX")
    width = 1 + max(int(put.get("offset", "0")) for put in inputs)
    lists = [_whole(p.text) for p in primitive.findall("p")]
    sizes = np.array([len(some) // width for some in lists])
    if primitive.tag == "polylist":
        sizes = _whole(primitive.findtext("vcount"))
    source = positions.get(vertex.get("source", ""))
    if source is None or (sizes <= 3).all():
        return
    rows = np.concatenate(lists).reshape(-1, width)
    index = rows[:, int(vertex.get("offset", "0"))]
    points = numbers((source.findtext("float_array") or "").encode()).reshape(-1, 3)
    if len(index) != sizes.sum() or index.max() >= len(points):
        return
    places = np.arange(len(index))
    faces = triangulated(points[index], sizes, places)
    if (faces != fan(sizes, places)).any():
        primitive.tag = "triangles"
        primitive[:] = inputs
        text = " ".join(map(str, rows[faces.ravel()].ravel().tolist()))
        ElementTree.SubElement(primitive, "p").text = text


def _whole(text: str | None) -> np.ndarray:
    return whole(numbers((text or "").encode()), "a polygon")
