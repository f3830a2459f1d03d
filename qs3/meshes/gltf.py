"""glTF 2.0 and its binary form GLB: the triangles of the scene, turned to z up.

trimesh reads the part of the file's JSON that is shown. Of a whole file trimesh 5.2 silently drops
nodes that carry a camera, triangle fans, and scenes that are not listed; reads sparse, compressed
and normalised vertices as other numbers; and ignores skins, morph targets, instances and what is
hidden.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import base64
import io
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from qs3.errors import MeshError
from qs3.meshes.mesh import Y_UP_TO_Z_UP, Colliders, Mesh
from qs3.meshes.polygons import Triangles

_HEADER = struct.Struct("<4sIII4s")  # of GLB: magic, version, length; of the JSON length and kind
_POINTS_AND_LINES, _TRIANGLES, _STRIP = range(4), 4, 5
_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_VISIBILITY, _INSTANCES = "KHR_node_visibility", "EXT_mesh_gpu_instancing"
_EXTENSIONS = (
    *("KHR_mesh_quantization", _VISIBILITY),  # understood; the others do not touch the surface
    *("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_"),
)


def read_gltf(data: bytes, folder: Path, colliders: Colliders) -> Triangles:
    """Read either form; buffers lie within the file, or in files of the same folder."""
    import trimesh

    tree, binary = _parsed(data)
    _keep_shown(tree, colliders)
    names = [str(index) for index in range(len(tree.get("buffers", [])))]
    buffers = {
        name: _buffer(buffer.get("uri"), binary, folder)
        for name, buffer in zip(names, tree.get("buffers", []), strict=True)
    }
    text = json.dumps({**tree, "buffers": [{"uri": name} for name in names]}).encode()
    file = io.BytesIO(text)
    scene: Any = trimesh.load(
        file, file_type="gltf", resolver=buffers, process=False, skip_materials=True
    )
    mesh = Mesh.from_trimesh(scene, keep_colliders=True)
    return mesh.vertices @ Y_UP_TO_Z_UP.T, mesh.faces


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


def _keep_shown(tree: dict[str, Any], colliders: Colliders) -> None:
    """Leave the nodes that are shown, and of them what is read; raise MeshError for what is not."""
    nodes = tree.get("nodes", [])
    waiting = _roots(tree)
    tree["scenes"], tree["scene"] = [{"nodes": waiting}], 0
    shown: dict[int, dict[str, Any]] = {}
    hidden = 0
    while waiting:
        index, *waiting = waiting
        node = nodes[index]
        extensions = node.get("extensions", {})
        if index in shown:
            raise MeshError("has a node in two places, or within itself")
        shown[index] = {}
        if colliders.left_out(node.get("name")):
            continue
        if extensions.get(_VISIBILITY, {}).get("visible", True) is False:
            hidden += 1
            continue
        waiting = [*waiting, *node.get("children", [])]
        placed = ("children", "matrix", "rotation", "scale", "translation")
        shown[index] = {key: node[key] for key in placed if key in node}
        if "mesh" in node:
            mesh = tree["meshes"][node["mesh"]]
            if not colliders.left_out(mesh.get("name")):
                _check(tree, node, mesh)
                shown[index]["mesh"] = node["mesh"]
    tree["nodes"] = [shown.get(index, {}) for index in range(len(nodes))]
    for mesh in tree.get("meshes", []):
        mesh["primitives"] = [
            part for part in mesh["primitives"] if part.get("mode", _TRIANGLES) >= _TRIANGLES
        ]
    if hidden:
        colliders.notes.append(f"{hidden} hidden nodes are left out with all below")


def _roots(tree: dict[str, Any]) -> list[int]:
    if scenes := tree.get("scenes"):
        roots: list[int] = dict(enumerate(scenes))[tree.get("scene", 0)].get("nodes", [])
        return roots
    nodes = tree.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    return [index for index in range(len(nodes)) if index not in children]


def _check(tree: dict[str, Any], node: dict[str, Any], mesh: dict[str, Any]) -> None:
    """Raise MeshError where the vertices that trimesh would read are not those that are shown."""
    weights = node.get("weights", mesh.get("weights", ()))
    for part in mesh["primitives"]:
        mode = part.get("mode", _TRIANGLES)
        if mode > _STRIP:
            raise MeshError("has triangle fans, which are not read: export triangles")
        targets = zip(weights, part.get("targets", ()), strict=False)
        if any(weight != 0 and "POSITION" in target for weight, target in targets):
            raise MeshError("has a morph target, which is not read: export it as it is shown")
        accessors = [(part["attributes"]["POSITION"], "VEC3"), (part.get("indices"), "SCALAR")]
        if mode >= _TRIANGLES:
            for index, kind in accessors[: 1 + ("indices" in part)]:
                _check_accessor(tree, tree["accessors"][index], kind)
    if "skin" in node or _INSTANCES in node.get("extensions", {}):
        raise MeshError("has a skin or instances, which are not read: export it as it is shown")


def _check_accessor(tree: dict[str, Any], accessor: dict[str, Any], kind: str) -> None:
    if "sparse" in accessor or accessor.get("normalized") or accessor["type"] != kind:
        raise MeshError("has sparse, compressed or normalised vertices, which are not read")
    view = tree["bufferViews"][accessor["bufferView"]]
    item = _BYTES[accessor["componentType"]] * {"VEC3": 3, "SCALAR": 1}[kind]
    start, stride = accessor.get("byteOffset", 0), view.get("byteStride", item)
    end = start + (accessor["count"] - 1) * stride + item
    if min(start, accessor["count"] - 1) < 0 or end > view["byteLength"]:
        raise MeshError("is truncated: its vertices reach beyond their buffer")
