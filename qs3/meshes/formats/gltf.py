"""glTF 2.0 and its binary form GLB: the triangles of the scene, turned to z up.

trimesh is not used here: it drops nodes that carry a camera, and triangle fans, and it reads
sparse and compressed vertices as zeros, all without a word. It would also have to be kept
from files elsewhere and from instances without end, by as many checks as this reader has.

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
from qs3.meshes.formats.arrays import (
    Y_UP_TO_Z_UP,
    Triangles,
    check_counts,
    fan,
    joined,
    transformed,
    used_part,
)

MAX_BUFFER_BYTES = 1 << 30

_POINTS_AND_LINES, _TRIANGLES, _STRIP, _FAN = range(4), 4, 5, 6
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3}
_EXTENSIONS = (
    "KHR_mesh_quantization",  # understood; the others do not touch the surface
    *("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_"),
)


def read_glb(data: bytes, folder: Path) -> Triangles:
    """Read GLB: a header, a JSON chunk and, in most files, a binary chunk."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise MeshError("is no GLB file, or cut within its header")
    version, length, json_length, kind = struct.unpack_from("<4xIII4s", data)
    if version != 2:
        raise MeshError(f"is glTF {version}, but only version 2 is read")
    end = 20 + json_length
    if length > len(data) or end > length or kind != b"JSON":
        raise MeshError(f"is truncated: {length} bytes were promised, {len(data)} are there")
    binary = None
    if end + 8 <= length:
        binary_length, kind = struct.unpack_from("<I4s", data, end)
        if kind == b"BIN\0":
            binary = data[end + 8 : min(end + 8 + binary_length, length)]
    return _Document(data[20:end], binary, folder).triangles()


def read_gltf(data: bytes, folder: Path) -> Triangles:
    """Read the JSON form; its buffers lie within it, or in files of the same folder."""
    return _Document(data, None, folder).triangles()


class _Document:
    def __init__(self, text: bytes, binary: bytes | None, folder: Path) -> None:
        try:
            self.tree = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise MeshError("is truncated or no glTF: its JSON cannot be parsed") from error
        if not isinstance(self.tree, dict) or "asset" not in self.tree:
            raise MeshError("is no glTF: its JSON does not describe an asset")
        if not str(self.tree["asset"].get("version", "")).startswith("2."):
            raise MeshError("is no glTF of version 2")
        required = [str(name) for name in self.tree.get("extensionsRequired", [])]
        foreign = [name for name in required if not name.startswith(_EXTENSIONS)]
        if foreign:
            raise MeshError(f"needs {', '.join(foreign)}, which is not read: export without")
        self.binary = binary
        self.folder = folder.resolve()
        self.buffers: dict[int, bytes] = {}
        self.shapes: dict[int, Triangles] = {}

    def triangles(self) -> Triangles:
        vertices, faces = joined(self._parts())
        return vertices @ Y_UP_TO_Z_UP.T, faces

    def _parts(self) -> Iterator[Triangles]:
        """Walk the nodes without recursion, in the order of the file."""
        nodes = self.tree.get("nodes", [])
        stack = [(index, np.eye(4)) for index in reversed(self._roots(nodes))]
        visited: set[int] = set()
        while stack:
            index, parent = stack.pop()
            if index in visited:
                raise MeshError("has a node in two places, or within itself")
            visited.add(index)
            node = nodes[index]
            matrix = parent @ _transform(node)
            stack += [(child, matrix) for child in reversed(node.get("children", []))]
            if "mesh" in node:
                if "skin" in node:
                    raise MeshError("has a skinned mesh, which is not read: export it unskinned")
                yield transformed(self._shape(node["mesh"]), matrix)

    def _roots(self, nodes: list[dict[str, Any]]) -> list[int]:
        if "scenes" in self.tree:
            return self.tree["scenes"][self.tree.get("scene", 0)].get("nodes", [])
        children = {child for node in nodes for child in node.get("children", [])}
        return [index for index in range(len(nodes)) if index not in children]

    def _shape(self, index: int) -> Triangles:
        if index not in self.shapes:
            primitives = self.tree["meshes"][index]["primitives"]
            self.shapes[index] = joined(
                self._primitive(primitive)
                for primitive in primitives
                if primitive.get("mode", _TRIANGLES) not in _POINTS_AND_LINES
            )
        return self.shapes[index]

    def _primitive(self, primitive: dict[str, Any]) -> Triangles:
        vertices = self._array(primitive["attributes"]["POSITION"], "VEC3")
        if "indices" in primitive:
            corners = self._array(primitive["indices"], "SCALAR")[:, 0].astype(np.int64)
        else:
            corners = np.arange(len(vertices))
        mode = primitive.get("mode", _TRIANGLES)
        if mode == _TRIANGLES:
            faces = corners[: len(corners) // 3 * 3].reshape(-1, 3)
        elif mode == _STRIP:
            faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        elif mode == _FAN:
            faces = fan(np.array([len(corners)]), corners)
        else:
            raise MeshError(f"has a primitive of the unknown mode {mode}")
        return used_part(vertices, faces)

    def _array(self, index: int, kind: str) -> np.ndarray:
        """[count, width] of one accessor."""
        accessor = self.tree["accessors"][index]
        if "bufferView" not in accessor or "sparse" in accessor:
            raise MeshError("has sparse or compressed vertices, which are not read")
        if accessor["type"] != kind:
            raise MeshError(f"has an accessor of type {accessor['type']}, expected {kind}")
        view = self.tree["bufferViews"][accessor["bufferView"]]
        start, length = view.get("byteOffset", 0), view["byteLength"]
        data = memoryview(self._buffer(view["buffer"]))[start : start + length]
        dtype, width = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[kind]
        stride = view.get("byteStride", dtype.itemsize * width)
        check_counts(accessor["count"] // 3, 0)  # also of indices: three to a face
        if start < 0 or len(data) < length or stride < dtype.itemsize * width:
            raise MeshError("is truncated: a buffer is shorter than what should be in it")
        values: np.ndarray = np.ndarray(  # raises if it does not fit into data
            (accessor["count"], width),
            dtype,
            data,
            accessor.get("byteOffset", 0),
            (stride, dtype.itemsize),
        )
        if accessor.get("normalized"):
            return np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def _buffer(self, index: int) -> bytes:
        if index not in self.buffers:
            self.buffers[index] = self._load(self.tree["buffers"][index].get("uri"))
        return self.buffers[index]

    def _load(self, uri: str | None) -> bytes:
        if uri is None:
            if self.binary is None:
                raise MeshError("has a buffer without data")
            return self.binary
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition("base64,")[2], validate=True)
        path = (self.folder / unquote(uri)).resolve()
        if not path.is_relative_to(self.folder):
            raise MeshError(f"refers to {uri!r}, which lies outside of its folder")
        if not path.is_file():
            raise MeshError(f"refers to {uri!r}, which is not there: put it beside the mesh")
        if sum(map(len, self.buffers.values())) + path.stat().st_size > MAX_BUFFER_BYTES:
            raise MeshError(f"refers to more than {MAX_BUFFER_BYTES} bytes in other files")
        return path.read_bytes()


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
