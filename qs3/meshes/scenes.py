"""Files of scenes: glTF with its binary form GLB, and 3MF; in metres, z up.

trimesh 5.2 reads glTF, whose nodes are turned here. What it would silently drop or read as other
numbers is refused. 3MF is read here: trimesh silently puts items of one object with one part number
in one place, and loses instances of deeply nested assemblies.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, https://github.com/3MFConsortium/spec_core
"""

import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.mesh import Y_UP_TO_Z_UP, Mesh, is_collider, merge, without_strays
from qs3.meshes.polygons import numbers

Element = ElementTree.Element

_METRES = {
    **{"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "meter": 1.0},
    **{"inch": 0.0254, "foot": 0.3048},
}
_OF_PRINTING = ("support", "solidsupport", "other")

_TRIANGLES, _FANS = 4, 6
_OF_SHAPE = {
    *("KHR_draco_mesh_compression", "EXT_meshopt_compression"),
    *("EXT_mesh_gpu_instancing", "KHR_node_visibility"),
}


def read_gltf(data: bytes, folder: Path, keep_colliders: bool) -> Mesh:
    """Read the triangles of the scene; buffers lie in the file, or in files next to it."""
    import trimesh

    tree = _tree(data)
    _refuse_what_is_misread(tree)
    files = {uri: folder / unquote(uri) for uri in _uris(tree)}
    for file in files.values():
        assert file.is_file(), f"its file {file.name} is not there"
    scene: Any = trimesh.load(
        io.BytesIO(data),
        file_type="glb" if data.startswith(b"glTF") else "gltf",
        resolver={uri: file.read_bytes() for uri, file in files.items()},
        process=False,
        skip_materials=True,
    )
    mesh = Mesh.from_trimesh(scene, keep_colliders)
    return mesh.at(mesh.vertices @ Y_UP_TO_Z_UP.T)


def buffer_files(path: Path) -> list[Path]:
    """The files next to a .gltf or .glb that hold its vertices; none of a damaged file."""
    if path.suffix.lower() not in (".gltf", ".glb"):
        return []
    try:
        files = [path.parent / unquote(uri) for uri in _uris(_tree(path.read_bytes()))]
    except Exception:  # reading the mesh raises it again
        return []
    return [file for file in files if file.is_file()]


def _tree(data: bytes) -> dict[str, Any]:
    """The file's JSON."""
    if data.startswith(b"glTF"):
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    found: dict[str, Any] = json.loads(data)
    return found


def _uris(tree: dict[str, Any]) -> list[str]:
    """Relative addresses of the buffers that are files, each once."""
    uris = [buffer.get("uri", "data:") for buffer in tree.get("buffers", [])]
    return list(dict.fromkeys(uri for uri in uris if not uri.startswith("data:")))


def _refuse_what_is_misread(tree: dict[str, Any]) -> None:
    nodes, meshes = tree.get("nodes", []), tree.get("meshes", [])
    parts = [part for mesh in meshes for part in mesh["primitives"]]
    places = [p["attributes"]["POSITION"] for p in parts if p.get("mode", 4) >= _TRIANGLES]
    accessors = [tree["accessors"][place] for place in places]
    extensions = {*tree.get("extensionsUsed", ()), *tree.get("extensionsRequired", ())}
    found = {
        "the extension " + ", ".join(extensions & _OF_SHAPE): bool(extensions & _OF_SHAPE),
        "no scenes": not tree.get("scenes"),
        "a camera with a mesh or nodes": any(
            "camera" in node and {"mesh", "children"} & node.keys() for node in nodes
        ),
        "a skin": any("skin" in node for node in nodes),
        "a morph target": any(any(one.get("weights", ())) for one in [*nodes, *meshes]),
        "triangle fans": any(part.get("mode") == _FANS for part in parts),
        "sparse or normalised vertices": any(
            "sparse" in accessor or accessor.get("normalized") for accessor in accessors
        ),
    }
    if any(found.values()):
        what = ", ".join(name for name, there in found.items() if there)
        raise MeshError(f"has {what}, which is not read: export plain triangles")


def read_3mf(data: bytes, folder: Path, keep_colliders: bool) -> Mesh:
    """Read the model without what supports it in print; one in several files is refused."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        (name,) = [n for n in archive.namelist() if "3d/3dmodel.model" in n.lower()]
        root = ElementTree.fromstring(archive.read(name))
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    objects = {element.get("id", ""): element for element in root.iter("object")}
    meshes = {name: _mesh(element) for name, element in objects.items()}
    colliders = 0

    def below(links: list[Element], above: np.ndarray) -> Iterator[Mesh]:
        nonlocal colliders
        for link in links:
            if any(key.endswith("}path") for key in link.attrib):
                raise MeshError("is spread over several files, which is not read: export one model")
            element = objects[link.get("objectid", "")]
            if element.get("type", "model") in _OF_PRINTING:
                continue
            if not keep_colliders and is_collider(element.get("name"), link.get("partnumber")):
                colliders += 1
                continue
            matrix = above @ _matrix(link.get("transform"))
            if mesh := meshes[element.get("id", "")]:
                yield mesh.transformed(matrix)
            yield from below(element.findall("components/component"), matrix)

    whole = merge(list(below(root.findall("build/item"), np.eye(4))))
    metres = _METRES[root.get("unit", "millimeter")]
    return replace(whole, vertices=metres * whole.vertices, colliders=colliders)


def _mesh(element: Element) -> Mesh | None:
    """The mesh of an object; None if it has none."""
    vertices = [[v.get(axis, "") for axis in "xyz"] for v in element.iter("vertex")]
    corners = [[t.get(key, "") for key in ("v1", "v2", "v3")] for t in element.iter("triangle")]
    if not corners:
        return None
    faces = np.array(corners, dtype=np.int64)
    return Mesh(*without_strays(np.array(vertices, dtype=np.float64), faces))


def _matrix(text: str | None) -> np.ndarray:
    """[4, 4] of 3MF's twelve numbers: a row for each axis, and the translation."""
    matrix = np.eye(4)
    if text is not None:
        matrix[:3] = numbers(text).reshape(4, 3).T
    return matrix
