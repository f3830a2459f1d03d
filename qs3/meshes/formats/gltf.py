"""glTF 2.0 and its binary form GLB: the triangles of the scene, turned to z up.

trimesh decodes it, from a copy of the JSON that holds the scene's surfaces and nothing else. Of a
whole file it drops nodes that carry a camera, triangle fans, and scenes that are not listed; it
reads sparse, compressed and normalised vertices as other numbers; it visits nodes in another
order; and it decodes and allocates what no surface needs. All that without a word.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from qs3.errors import MeshError, MeshMemoryError
from qs3.meshes.finishes import FoundFinishes
from qs3.meshes.formats.arrays import Y_UP_TO_Z_UP, Triangles, check_counts
from qs3.meshes.formats.by_trimesh import MAX_PARTS, assembled, loaded
from qs3.meshes.formats.colliders import Colliders
from qs3.meshes.formats.gltf_materials import finish_of
from qs3.utils.memory import check_memory
from qs3.utils.plural import counted

MAX_BUFFER_BYTES = 1 << 30

_HEADER = struct.Struct("<4xIII4s")  # of GLB: version, length, and of the JSON length and kind
_TRIANGLES, _STRIP = 4, 5  # below them: points and lines; above: fans
_LARGEST = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535}  # normalised, these mean 1
_UNUSED = {"componentType": 5121, "type": "SCALAR", "count": 0}
_VISIBILITY, _INSTANCES = "KHR_node_visibility", "EXT_mesh_gpu_instancing"
_EXTENSIONS = (
    *("KHR_mesh_quantization", _VISIBILITY),  # understood; the others do not touch the surface
    *("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_"),
)


def read_glb(
    data: bytes, folder: Path, colliders: Colliders, found: FoundFinishes | None = None
) -> Triangles:
    """Read GLB: a header, a JSON chunk and, in most files, a binary chunk."""
    if len(data) < _HEADER.size or data[:4] != b"glTF":
        raise MeshError("is not a GLB file, or cut within its header")
    version, length, json_length, kind = _HEADER.unpack_from(data)
    if version != 2:
        raise MeshError(f"is glTF {version}, but only version 2 is read")
    end = _HEADER.size + json_length
    if length > len(data) or end > length or kind != b"JSON":
        raise MeshError(f"is truncated: {length} bytes were promised, {len(data)} are there")
    binary = None
    if end + 8 <= length:
        binary_length, kind = struct.unpack_from("<I4s", data, end)
        if kind == b"BIN\0":
            binary = data[end + 8 : min(end + 8 + binary_length, length)]
    return _triangles(data[_HEADER.size : end], binary, folder, colliders, found)


def read_gltf(
    data: bytes, folder: Path, colliders: Colliders, found: FoundFinishes | None = None
) -> Triangles:
    """Read the JSON form; its buffers lie within it, or in files of the same folder."""
    return _triangles(data, None, folder, colliders, found)


def buffer_files(path: Path) -> list[Path]:
    """The files beside a .gltf or .glb that hold its vertices, each once.

    Empty of other formats, and of a file that is damaged or refers to what is not there.
    """
    suffix = path.suffix.lower()
    if suffix not in (".gltf", ".glb"):
        return []
    try:
        check_memory(path.stat().st_size, "", MeshMemoryError)
        with path.open("rb") as file:
            length = _HEADER.unpack(file.read(_HEADER.size))[2] if suffix == ".glb" else -1
            buffers = _parsed(file.read(length)).get("buffers", [])
        uris = [buffer.get("uri") or "data:" for buffer in buffers]
        folder = path.parent.resolve()
        return list({_beside(uri, folder): None for uri in uris if not uri.startswith("data:")})
    except Exception:  # what damaged bytes raise cannot be listed; reading the mesh will say it
        return []


def _triangles(
    text: bytes,
    binary: bytes | None,
    folder: Path,
    colliders: Colliders,
    finishes: FoundFinishes | None,
) -> Triangles:
    tree = _parsed(text)
    nodes = _nodes(tree, colliders)
    surfaces = _Surfaces(tree)
    for node in nodes:
        if "mesh" in node:
            node["mesh"] = surfaces.place(node["mesh"])
    buffers = _buffers(tree, binary, folder.resolve())
    prepared = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": _roots(tree)[::-1]}],
        "nodes": nodes,
        "meshes": surfaces.meshes,
        "bufferViews": tree.get("bufferViews", []),
        "accessors": [
            accessor if index in surfaces.accessors else _UNUSED
            for index, accessor in enumerate(tree.get("accessors", []))
        ],
        "buffers": [{"uri": name} for name in buffers],
    }
    found = loaded("gltf", json.dumps(prepared).encode(), resolver=buffers)
    for shape, largest in zip(found["geometry"].values(), surfaces.largest, strict=True):
        if largest:
            shape["vertices"] = np.maximum(shape["vertices"] / largest, -1.0)
    if finishes is None:
        vertices, faces = assembled(found)
    else:
        made_of = _finishes(tree, surfaces, found["geometry"], finishes)
        vertices, faces = assembled(found, placed=made_of)
    return vertices @ Y_UP_TO_Z_UP.T, faces


def _finishes(
    tree: dict[str, Any], surfaces: _Surfaces, shapes: Iterable[str], found: FoundFinishes
) -> Callable[[str, int], None]:
    """What is to be told of each instance that is placed."""
    of_shape = dict(zip(shapes, surfaces.materials, strict=True))
    materials = tree.get("materials", [])

    def placed(name: str, faces: int) -> None:
        index = of_shape[name]
        found.add(faces, *((None,) if index is None else finish_of(materials[index])))

    return placed


def _parsed(text: bytes) -> dict[str, Any]:
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MeshError("is truncated or not glTF: its JSON cannot be parsed") from error
    if not isinstance(tree, dict) or "asset" not in tree:
        raise MeshError("is not glTF: its JSON does not describe an asset")
    if not str(tree["asset"].get("version", "")).startswith("2."):
        raise MeshError("is not glTF of version 2")
    required = [str(name) for name in tree.get("extensionsRequired", [])]
    foreign = [name for name in required if not name.startswith(_EXTENSIONS)]
    if foreign:
        raise MeshError(f"needs {', '.join(foreign)}, which is not read: export without")
    return tree


def _roots(tree: dict[str, Any]) -> list[int]:
    if scenes := tree.get("scenes"):
        if not 0 <= (scene := tree.get("scene", 0)) < len(scenes):
            raise MeshError(f"has no scene {scene}, which it is said to show")
        return scenes[scene].get("nodes", [])
    nodes = tree.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    return [index for index in range(len(nodes)) if index not in children]


def _nodes(tree: dict[str, Any], colliders: Colliders) -> list[dict[str, Any]]:
    """What trimesh shall see of each node; of colliders and what is outside or hidden, nothing.

    Children stand in reverse, for trimesh visits the last one first. A node's matrix is made here:
    trimesh normalises its quaternion, which changes the last digits.
    """
    nodes = tree.get("nodes", [])
    prepared: list[dict[str, Any]] = [{} for _ in nodes]
    waiting = list(_roots(tree))
    visited: set[int] = set()
    hidden = 0
    while waiting:
        index = waiting.pop()
        if index in visited:
            raise MeshError("has a node in two places, or within itself")
        visited.add(index)
        node = nodes[index]
        if len(visited) > MAX_PARTS:
            raise MeshError(f"has more than {MAX_PARTS} nodes")
        if colliders.left_out(node.get("name")):
            continue
        extensions = node.get("extensions", {})
        if extensions.get(_VISIBILITY, {}).get("visible", True) is False:  # nor what is below it
            hidden += 1
            continue
        children = node.get("children", [])
        waiting += children
        matrix = _transform(node).T.ravel().tolist()  # column-major
        prepared[index] = {"children": children[::-1], "matrix": matrix}
        if "mesh" in node:
            if "skin" in node:
                raise MeshError("has a skinned mesh, which is not read: export it unskinned")
            if _INSTANCES in extensions:
                raise MeshError(
                    f"has instances of a mesh by {_INSTANCES}, which are not read: export each as "
                    "a node"
                )
            mesh = tree["meshes"][node["mesh"]]
            if not colliders.left_out(mesh.get("name")):
                _check_targets(mesh, node)
                prepared[index]["mesh"] = node["mesh"]
    if hidden:
        nodes_are = counted(hidden, "node is", "nodes are")
        colliders.notes.append(f"{nodes_are} hidden, and left out with all below")
    return prepared


def _check_targets(mesh: dict[str, Any], node: dict[str, Any]) -> None:
    """Raise MeshError where morph targets move the vertices: without a node's weights, a mesh's."""
    weights = node.get("weights", mesh.get("weights", ()))
    for part in mesh["primitives"]:
        for weight, target in zip(weights, part.get("targets", ()), strict=False):
            if weight != 0 and "POSITION" in target:
                raise MeshError(
                    f"has a morph target with the weight {weight:g}, which is not read: export it "
                    "with its shape applied, or with all weights at 0"
                )


class _Surfaces:
    """The meshes that the scene uses, without all but their positions and corners.

    Attributes:
        meshes: in the order of their first use.
        accessors: the indices of those that the meshes use.
        largest: for each primitive what its integers are divided by, or None.
        materials: for each primitive the index of its material in the file, or None.
    """

    def __init__(self, tree: dict[str, Any]) -> None:
        self.tree = tree
        self.meshes: list[dict[str, Any]] = []
        self.places: dict[int, int] = {}
        self.accessors: set[int] = set()
        self.largest: list[int | None] = []
        self.materials: list[int | None] = []

    def place(self, index: int) -> int:
        """Where in `meshes` the mesh with this index in the file is, or comes to be."""
        if index not in self.places:
            parts = self.tree["meshes"][index]["primitives"]
            surfaces = [part for part in parts if part.get("mode", _TRIANGLES) >= _TRIANGLES]
            self.meshes.append({"primitives": [self._primitive(part) for part in surfaces]})
            self.places[index] = len(self.meshes) - 1
        return self.places[index]

    def _primitive(self, primitive: dict[str, Any]) -> dict[str, Any]:
        mode = primitive.get("mode", _TRIANGLES)
        if mode > _STRIP:
            what = "triangle fans" if mode == 6 else f"primitives of the unknown mode {mode}"
            raise MeshError(f"has {what}, which are not read: export triangles")
        position = primitive["attributes"]["POSITION"]
        accessor = self._accessor(position, "VEC3")
        normalised = accessor.get("normalized")
        self.largest.append(_LARGEST[accessor["componentType"]] if normalised else None)
        self.materials.append(primitive.get("material"))
        made = {"mode": mode, "attributes": {"POSITION": position}}
        if "indices" in primitive:
            self._accessor(primitive["indices"], "SCALAR")
            made["indices"] = primitive["indices"]
        return made

    def _accessor(self, index: int, kind: str) -> dict[str, Any]:
        accessor = self.tree["accessors"][index]
        if "bufferView" not in accessor or "sparse" in accessor:
            raise MeshError("has sparse or compressed vertices, which are not read")
        if accessor["type"] != kind:
            raise MeshError(f"has an accessor of type {accessor['type']}, expected {kind}")
        view = self.tree["bufferViews"][accessor["bufferView"]]
        offsets = accessor.get("byteOffset", 0), view.get("byteOffset", 0)
        if min(accessor["count"], *offsets, view.get("byteStride", 4) - 4) < 0:
            raise MeshError("has a count, an offset or a stride that glTF does not allow")
        check_counts(accessor["count"] // 3, 0)  # also of indices: three to a face
        self.accessors.add(index)
        return accessor


def _buffers(tree: dict[str, Any], binary: bytes | None, folder: Path) -> dict[str, bytes]:
    buffers: dict[str, bytes] = {}
    for index, buffer in enumerate(tree.get("buffers", [])):
        left = MAX_BUFFER_BYTES - sum(map(len, buffers.values()))
        buffers[str(index)] = _buffer(buffer.get("uri"), binary, folder, left)
    return buffers


def _buffer(uri: str | None, binary: bytes | None, folder: Path, most: int) -> bytes:
    """At most `most` bytes of a file in the folder, or of the file itself."""
    if uri is None:
        if binary is None:
            raise MeshError("has a buffer without data")
        return binary
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition("base64,")[2], validate=True)
    path = _beside(uri, folder)
    if path.stat().st_size > most:
        raise MeshError(f"refers to more than {MAX_BUFFER_BYTES} bytes in other files")
    return path.read_bytes()


def _beside(uri: str, folder: Path) -> Path:
    """The file that a buffer names, in the folder or below it."""
    path = (folder / unquote(uri)).resolve()
    if not path.is_relative_to(folder):
        raise MeshError(f"refers to {uri!r}, which lies outside of its folder")
    if not path.is_file():
        raise MeshError(f"refers to {uri!r}, which is not there: put it next to the mesh")
    return path


def _transform(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T  # column-major
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))  # a unit quaternion
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= np.array(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix
