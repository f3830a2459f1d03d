"""PLY, text and binary of either byte order, with polygons of any and of mixed sizes.

trimesh 5.2 refuses binary files in which triangles and quads are mixed, which is what Blender
writes, and divides concave polygons wrongly.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.polygons import Triangles, numbers, triangulated, whole

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4"},
    **{"uint32": "u4", "int64": "i8", "uint64": "u8"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_END = re.compile(rb"\bend_header[ \t]*(?:\r\n|\n|\r)")


class _Property(NamedTuple):
    name: str
    dtype: np.dtype
    count_dtype: np.dtype | None = None  # of lists


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


def read_ply(data: bytes) -> Triangles:
    """Read the elements "vertex" and "face"; all else is stepped over."""
    vertices = polygons = None
    for element, columns in _elements(data):
        if element.name == "vertex":
            vertices = _vertices(columns)
        elif element.name == "face":
            key = "vertex_indices" if "vertex_indices" in columns else "vertex_index"
            sizes, corners = columns[key]
            polygons = sizes, whole(corners.astype(np.float64))
        if vertices is not None and polygons is not None:
            return vertices, triangulated(vertices, *polygons)
    raise MeshError("has no faces: it is a point cloud, or not made of triangles")


def _vertices(columns: dict[str, Any]) -> np.ndarray:
    names = [axis if axis in columns else axis.upper() for axis in "xyz"]
    return np.stack([columns[name] for name in names], axis=1).astype(np.float64)


def _elements(data: bytes) -> Iterator[tuple[_Element, dict[str, Any]]]:
    """Each element with its columns by name, lists as (sizes [N], items [sum(sizes)])."""
    elements, body = _parsed(data)
    offset = 0
    for element in elements:
        found = _uniform(element, body, offset)
        columns, offset = _ragged(element, body, offset) if found is None else found
        yield element, columns


def _parsed(data: bytes) -> tuple[list[_Element], bytes]:
    """Elements, and the data behind the header; text becomes binary of float64."""
    end = _END.search(data)
    if end is None or not data.startswith(b"ply"):
        raise MeshError("is not a PLY file, or cut within its header")
    order, text = "<", False
    elements: list[_Element] = []

    def dtype(word: str) -> np.dtype:
        return np.dtype("<f8" if text else order + _TYPES[word])

    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, _]:
                order, text = _BYTE_ORDERS[name], name == "ascii"
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count, kind, name]:
                elements[-1].properties.append(_Property(name, dtype(kind), dtype(count)))
            case ["property", kind, name]:
                elements[-1].properties.append(_Property(name, dtype(kind)))
            case _:
                raise MeshError(f"has the header line {line[:80]!r}")
    body = data[end.end() :]
    return elements, numbers(body).astype("<f8").tobytes() if text else body


def _uniform(element: _Element, body: bytes, offset: int) -> tuple[dict[str, Any], int] | None:
    """An element in one piece, and the offset behind it: all lists are as long as in the first row.

    None where they are not, or the file ends before.
    """
    fields: list[tuple[Any, ...]] = []
    sizes: dict[int, int] = {}  # of the lists in the first row
    place = offset
    for i, prop in enumerate(element.properties):
        size = 1
        if prop.count_dtype is not None:
            size = sizes[i] = _size(prop, body, place) if element.rows else 0
            fields.append((f"n{i}", prop.count_dtype))
            place += prop.count_dtype.itemsize
        fields.append((f"p{i}", prop.dtype, (size,)) if i in sizes else (f"p{i}", prop.dtype))
        place += size * prop.dtype.itemsize
    row = np.dtype(fields)
    end = offset + element.rows * row.itemsize
    if end > len(body) and sizes:
        return None
    table = np.frombuffer(body, row, element.rows, offset)
    if not all((table[f"n{i}"] == size).all() for i, size in sizes.items()):
        return None
    columns: dict[str, Any] = {}
    for i, prop in enumerate(element.properties):
        items: Any = table[f"p{i}"]
        if i in sizes:
            items = np.full(element.rows, sizes[i]), items.reshape(-1)
        columns[prop.name] = items
    return columns, end


def _ragged(element: _Element, body: bytes, offset: int) -> tuple[dict[str, Any], int]:
    """Row by row; only lists are kept: the scalars next to them are not needed."""
    lists: dict[str, list[np.ndarray]] = {p.name: [] for p in element.properties if p.count_dtype}
    for _ in range(element.rows):
        for prop in element.properties:
            if prop.count_dtype is None:
                offset += prop.dtype.itemsize
                continue
            size = _size(prop, body, offset)
            offset += prop.count_dtype.itemsize
            lists[prop.name].append(np.frombuffer(body, prop.dtype, size, offset))
            offset += size * prop.dtype.itemsize
    sizes = {name: np.array([len(row) for row in rows]) for name, rows in lists.items()}
    return {name: (sizes[name], np.concatenate(rows)) for name, rows in lists.items()}, offset


def _size(prop: _Property, body: bytes, offset: int) -> int:
    assert prop.count_dtype is not None
    size = float(np.frombuffer(body, prop.count_dtype, 1, offset)[0])
    if not (0 <= size <= len(body) and size == int(size)):
        raise MeshError(f"has a list {prop.name} of {size:g} items")
    return int(size)
