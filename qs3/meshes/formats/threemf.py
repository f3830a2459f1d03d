"""3MF (3D Manufacturing Format), by trimesh: all items of the build plate, in metres, z up.

https://github.com/3MFConsortium/spec_core
"""

from __future__ import annotations

import io
import zipfile
from typing import Any
from xml.parsers import expat

from qs3.errors import MeshError, MeshMemoryError
from qs3.meshes.formats.arrays import Triangles
from qs3.meshes.formats.by_trimesh import assembled, check_instances, loaded
from qs3.meshes.formats.colliders import Colliders
from qs3.utils.memory import check_memory

_PEAK = 18  # of memory to what the archive unpacks to; measured with 330,000 triangles

_METRES = {
    **{"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "meter": 1.0},
    **{"inch": 0.0254, "foot": 0.3048, "millimeters": 1e-3},  # the last: trimesh's default
}


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
            _check(archive.read(names[0]))
    except zipfile.BadZipFile as error:
        raise MeshError(f"is truncated or not a 3MF file: {error}") from error
    found = loaded("3mf", data, postprocess=False)
    unit = found["metadata"]["units"]
    if unit not in _METRES:
        raise MeshError(f"has the unknown unit {unit!r}")
    vertices, faces = assembled(found, colliders)
    return _METRES[unit] * vertices, faces


def _check(model: bytes) -> None:
    """Raise MeshError for a model that trimesh would misread, or unfold without end."""
    children: dict[str, list[str]] = {"": []}  # the build under "", objects under their ids
    current = ""

    def start(tag: str, attributes: dict[str, Any]) -> None:
        nonlocal current
        kind = tag.rpartition(":")[2]
        if kind == "object":
            current = attributes.get("id", "")
            children.setdefault(current, [])
        elif kind == "build":
            current = ""
        elif kind in ("component", "item"):
            # trimesh takes all objects of such a file, and not the one that is meant.
            if any(name.rpartition(":")[2] == "path" for name in attributes):
                raise MeshError("is spread over several files, which is not read: export one model")
            children[current].append(attributes.get("objectid", ""))

    def doctype(*_: Any) -> None:
        raise MeshError("has a document type declaration, which is not read")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.StartDoctypeDeclHandler = start, doctype
    parser.Parse(model, True)
    for name in {name for names in children.values() for name in names} - set(children):
        raise MeshError(f"refers to the object {name!r}, which is not in this file")
    check_instances(children, "")
