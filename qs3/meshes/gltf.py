"""glTF 2.0 and its binary form GLB: the triangles of the scene, turned to z up.

Read here: trimesh 5.2 silently drops nodes that carry a camera, triangle fans, and scenes that are
not listed; reads sparse, compressed and normalised vertices as other numbers; and knows neither
skins nor morph targets nor instances nor what is hidden.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.mesh import Y_UP_TO_Z_UP, Colliders, used_part
from qs3.meshes.polygons import Triangles, joined

_HEADER = struct.Struct("<4sIII4s")  # of GLB: magic, version, length; of the JSON length and kind
_POINTS_AND_LINES, _TRIANGLES, _STRIP = range(4), 4, 5
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_VISIBILITY, _INSTANCES = "KHR_node_visibility", "EXT_mesh_gpu_instancing"
_EXTENSIONS = (
    *("KHR_mesh_quantization", _VISIBILITY),  # understood; the others do not touch the surface
    *("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_"),
)


def read_gltf(data: bytes, folder: Path, colliders: Colliders) -> Triangles:
    """Read either form; buffers lie within the file, or in files of the same folder."""
    tree, binary = _parsed(data)
    buffers = [_buffer(one.get("uri"), binary, folder) for one in tree.get("buffers", [])]
    vertices, faces = joined(_Scene(tree, buffers, colliders).parts())
    return vertices @ Y_UP_TO_Z_UP.T, faces


def buffer_files(path: Path) -> list[Path]:
    """The files beside a .gltf or .glb that hold its vertices, each once.

    Empty of other formats, and of a file that is damaged or refers to what is not there.
    """
    if path.suffix.lower() not in (".gltf", ".glb"):
        return []
    try:
        buffers = _parsed(path.read_bytes())[0].get("buffers", [])
        uris = [buffer.get("uri") or "data:" for buffer in buffers]
        files = [_beside(uri, path.parent) for uri in uris if not uri.startswith("data:")]
        return list(dict.fromkeys(files))
    except Exception:  # reading the mesh raises it again
        return []


def _parsed(data: bytes) -> tuple[dict[str, Any], bytes | None]:
    """The JSON, and GLB's binary chunk where there is one."""
    text, binary = data, None
    if data[:4] == b"glTF":
        end = _HEADER.size + _HEADER.unpack_from(data)[3]
        text = data[_HEADER.size : end]
        if end + 8 <= len(data):
            length, kind = struct.unpack_from("<I4s", data, end)
            binary = data[end + 8 : end + 8 + length] if kind == b"BIN\0" else None
    tree = json.loads(text)
    foreign = [e for e in tree.get("extensionsRequired", []) if not e.startswith(_EXTENSIONS)]
    if foreign or not str(tree["asset"]["version"]).startswith("2."):
        raise MeshError(f"is not glTF of version 2, or needs an extension: {', '.join(foreign)}")
    return tree, binary


def _buffer(uri: str | None, binary: bytes | None, folder: Path) -> bytes:
    if uri is None:
        return binary or b""
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition("base64,")[2], validate=True)
    return _beside(uri, folder).read_bytes()


def _beside(uri: str, folder: Path) -> Path:
    """The file that a buffer names, in the folder or below it."""
    path = (folder.resolve() / unquote(uri)).resolve()
    if not path.is_relative_to(folder.resolve()) or not path.is_file():
        raise MeshError(f"refers to {uri!r}, which is not there or outside of its folder")
    return path


class _Scene:
    """The surfaces of a file's scene."""

    def __init__(self, tree: dict[str, Any], buffers: list[bytes], colliders: Colliders) -> None:
        self.tree, self.buffers, self.colliders = tree, buffers, colliders
        self.hidden = 0

    def parts(self) -> Iterator[Triangles]:
        """All instances of meshes, put into the world, in the order of the file."""
        for root in self._roots():
            yield from self._below(root, np.eye(4))
        if self.hidden:
            self.colliders.notes.append(f"{self.hidden} hidden nodes are left out with all below")

    def _roots(self) -> list[int]:
        if scenes := self.tree.get("scenes"):
            roots: list[int] = dict(enumerate(scenes))[self.tree.get("scene", 0)].get("nodes", [])
            return roots
        nodes = self.tree.get("nodes", [])
        children = {child for node in nodes for child in node.get("children", [])}
        return [index for index in range(len(nodes)) if index not in children]

    def _below(self, index: int, above: np.ndarray) -> Iterator[Triangles]:
        """The surfaces of a node and of those below it; of colliders and what is hidden, none."""
        node = self.tree["nodes"][index]
        if self.colliders.left_out(node.get("name")):
            return
        if node.get("extensions", {}).get(_VISIBILITY, {}).get("visible", True) is False:
            self.hidden += 1
            return
        world = above @ _transform(node)
        if "mesh" in node:
            mesh = self.tree["meshes"][node["mesh"]]
            if not self.colliders.left_out(mesh.get("name")):
                _check_rigid(node, mesh)
                for part in mesh["primitives"]:
                    if part.get("mode", _TRIANGLES) not in _POINTS_AND_LINES:
                        own, faces = used_part(*self._primitive(part))
                        yield own @ world[:3, :3].T + world[:3, 3], faces
        for child in node.get("children", []):
            yield from self._below(child, world)

    def _primitive(self, part: dict[str, Any]) -> Triangles:
        """Vertices and faces of a list or a strip of triangles."""
        vertices = self._numbers(part["attributes"]["POSITION"], "VEC3", 3)
        corners = np.arange(len(vertices))
        if "indices" in part:
            corners = self._numbers(part["indices"], "SCALAR", 1)[:, 0].astype(np.int64)
        mode = part.get("mode", _TRIANGLES)
        if mode == _TRIANGLES:
            return vertices, corners.reshape(-1, 3)
        if mode != _STRIP:
            raise MeshError("has triangle fans, which are not read: export triangles")
        faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        faces[1::2] = faces[1::2, ::-1]  # all of one orientation
        return vertices, faces

    def _numbers(self, index: int, kind: str, columns: int) -> np.ndarray:
        """[n, columns] float64 of an accessor."""
        accessor = self.tree["accessors"][index]
        if "bufferView" not in accessor or "sparse" in accessor or accessor["type"] != kind:
            raise MeshError("has sparse or compressed vertices, which are not read")
        view = self.tree["bufferViews"][accessor["bufferView"]]
        dtype = np.dtype(_TYPES[accessor["componentType"]])
        start, buffer = view.get("byteOffset", 0), self.buffers[view["buffer"]]
        data = buffer[start : start + view["byteLength"]]
        strides = (view.get("byteStride", columns * dtype.itemsize), dtype.itemsize)
        shape, offset = (accessor["count"], columns), accessor.get("byteOffset", 0)
        values = np.ndarray(shape, dtype, data, offset, strides).astype(np.float64)
        if accessor.get("normalized"):
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values


def _check_rigid(node: dict[str, Any], mesh: dict[str, Any]) -> None:
    """Raise MeshError where the vertices that are stored are not those that are shown."""
    weights = node.get("weights", mesh.get("weights", ()))
    morphed = any(
        weight != 0 and "POSITION" in target
        for part in mesh["primitives"]
        for weight, target in zip(weights, part.get("targets", ()), strict=False)
    )
    if morphed or "skin" in node or _INSTANCES in node.get("extensions", {}):
        raise MeshError(
            "has a skin, a morph target or instances, which are not read: export it as it is shown"
        )


def _transform(node: dict[str, Any]) -> np.ndarray:
    """[4, 4] of a node in the one above it."""
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
