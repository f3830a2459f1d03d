"""3MF (3D Manufacturing Format): all items of the build plate, in metres, z up.

trimesh reads the meshes. Which of them stand where is read here: trimesh puts items of one object
with one part number in one place, and loses instances of deeply nested assemblies.

https://github.com/3MFConsortium/spec_core
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple
from xml.parsers import expat

import numpy as np

from qs3.errors import MeshError, MeshMemoryError
from qs3.meshes.formats.arrays import Triangles, joined, transformed, used_part
from qs3.meshes.formats.by_trimesh import check_instances, loaded
from qs3.meshes.formats.colliders import Colliders
from qs3.utils.memory import check_memory
from qs3.utils.plural import counted

_PEAK = 18  # of memory to what the archive unpacks to; measured with 330,000 triangles

_METRES = {
    **{"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "meter": 1.0},
    **{"inch": 0.0254, "foot": 0.3048, "millimeters": 1e-3},  # the last: trimesh's default
}
_NO_PART = ("support", "solidsupport", "other")
"""Types of objects that are no part of what is made: they hold it while it is printed, or help."""


class _Instance(NamedTuple):
    of: str  # an object's id
    matrix: np.ndarray  # [4, 4]
    part_number: str | None  # of an item


@dataclass
class _Model:
    """Objects by their ids; the build plate is the one under ""."""

    children: dict[str, list[_Instance]] = field(default_factory=lambda: {"": []})
    names: dict[str, str | None] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    meshes: dict[str, None] = field(default_factory=dict)  # ids, in trimesh's order


def read(data: bytes, colliders: Colliders) -> Triangles:
    """Read the model; one that is spread over several files of the archive is refused."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            check_memory(
                _PEAK * sum(info.file_size for info in archive.infolist()), "", MeshMemoryError
            )
            names = [n for n in archive.namelist() if "3d/3dmodel.model" in n.lower()]
            if len(names) != 1:
                raise MeshError("is not a 3MF file: its archive holds no 3D/3dmodel.model")
            model = _parsed(archive.read(names[0]))
    except zipfile.BadZipFile as error:
        raise MeshError(f"is truncated or not a 3MF file: {error}") from error
    found = loaded("3mf", data, postprocess=False)
    unit = found["metadata"]["units"]
    if unit not in _METRES:
        raise MeshError(f"has the unknown unit {unit!r}")
    shapes = dict(zip(model.meshes, found["geometry"].values(), strict=True))
    vertices, faces = joined(_parts(model, shapes, colliders))
    return _METRES[unit] * vertices, faces


def _parts(
    model: _Model, shapes: Mapping[str, Mapping[str, Any]], colliders: Colliders
) -> Iterator[Triangles]:
    """All instances of meshes, put into the world, in the order in which trimesh visits them."""
    no_parts = 0
    waiting: list[tuple[str, list[np.ndarray]]] = [("", [])]
    while waiting:
        name, path = waiting.pop()
        kept = []
        for instance in model.children[name]:
            if model.types[instance.of] in _NO_PART:
                no_parts += 1
            elif not colliders.left_out(model.names[instance.of], instance.part_number):
                kept.append((instance.of, [*path, instance.matrix]))
        if model.children[name]:
            # The first, and then from the last to the second, those of one object together.
            order = {one: at for at, one in reversed(list(enumerate(of for of, _ in kept)))}
            kept.sort(key=lambda one: order[one[0]])
            waiting += kept[1:] + kept[:1]
            continue
        if name not in shapes:
            raise MeshError(f"has the object {name!r} without a mesh")
        vertices, faces = (np.asarray(shapes[name][key]) for key in ("vertices", "faces"))
        if len(faces):
            matrix = np.linalg.multi_dot(path) if len(path) > 1 else path[0]
            yield transformed(used_part(vertices, faces.astype(np.int64)), matrix)
    if no_parts:
        some = counted(no_parts, "object is", "objects are")
        colliders.notes.append(
            f"{some} left out as no part of the model (type {', '.join(_NO_PART)})"
        )


def _parsed(text: bytes) -> _Model:
    """What is where; MeshError for a model that trimesh would misread, or unfold without end."""
    model = _Model()
    current = ""

    def start(tag: str, attributes: dict[str, Any]) -> None:
        nonlocal current
        kind = tag.rpartition(":")[2]
        if kind == "object":
            current = attributes.get("id", "")
            model.children.setdefault(current, [])
            model.names[current] = attributes.get("name")
            model.types[current] = attributes.get("type", "model")
        elif kind == "mesh":
            model.meshes[current] = None
        elif kind == "build":
            current = ""
        elif kind in ("component", "item"):
            # trimesh takes all objects of such a file, and not the one that is meant.
            if any(name.rpartition(":")[2] == "path" for name in attributes):
                raise MeshError("is spread over several files, which is not read: export one model")
            model.children[current].append(
                _Instance(
                    attributes.get("objectid", ""),
                    _matrix(attributes.get("transform")),
                    attributes.get("partnumber"),
                )
            )

    def doctype(*_: Any) -> None:
        raise MeshError("has a document type declaration, which is not read")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.StartDoctypeDeclHandler = start, doctype
    parser.Parse(text, True)
    if not model.children[""]:
        raise MeshError("has no items on its build plate")
    children = {name: [one.of for one in some] for name, some in model.children.items()}
    for name in {name for names in children.values() for name in names} - set(model.names):
        raise MeshError(f"refers to the object {name!r}, which is not in this file")
    check_instances(children, "")
    return model


def _matrix(text: str | None) -> np.ndarray:
    """[4, 4] of the format's twelve numbers: a row for each axis, and the translation."""
    matrix = np.eye(4)
    if text is not None:
        matrix[:3] = np.array(text.split(), dtype=np.float64).reshape(4, 3).T
    return matrix
