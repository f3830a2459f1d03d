"""PLY, text and binary of either byte order, with polygons of any and of mixed sizes.

trimesh 5.2 is not used here: it refuses binary files in which triangles and quads are mixed,
which is what Blender writes, and divides quads in another order.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.errors import MeshError, MeshMemoryError
from qs3.meshes.finishes import FoundFinishes
from qs3.meshes.formats.arrays import Triangles, check_counts, numbers, whole
from qs3.meshes.formats.ply_colours import add_colours, colours_of
from qs3.meshes.formats.polygons import triangulated
from qs3.utils.memory import check_memory

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4"},
    **{"uint32": "u4", "int64": "i8", "uint64": "u8"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_END = re.compile(rb"\bend_header[ \t]*(?:\r\n|\n|\r)")
_MAX_HEADER_BYTES = 1 << 20


@dataclass(frozen=True)
class _Property:
    name: str
    kind: np.dtype  # as the header says
    dtype: np.dtype  # as it is read
    count_dtype: np.dtype | None  # of lists


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property]


def read(data: bytes, found: FoundFinishes | None = None) -> Triangles:
    """Read the elements "vertex" and "face"; all else is stepped over.

    `found`: also of the faces' colours, or else the mean of their corners'.
    """
    vertices = corners = None
    colours: dict[str, np.ndarray | None] = {}
    for element, columns in _elements(data):
        name = element.name
        if found is not None and name in ("vertex", "face"):
            colours[name] = colours_of(columns, {p.name: p.kind for p in element.properties})
        if name == "vertex":
            vertices = _vertices(columns)
        elif name == "face":
            key = next((n for n in ("vertex_indices", "vertex_index") if n in columns), None)
            if key is None:
                raise MeshError("has faces without vertex_indices")
            sizes, items = columns[key]
            corners = whole(items.astype(np.float64), "a vertex index")
        if vertices is not None and corners is not None:
            faces = triangulated(vertices, sizes, corners)
            if found is not None:
                per_face = colours.get("face")
                if per_face is not None:
                    per_face = np.repeat(per_face, np.maximum(sizes - 2, 0), axis=0)
                add_colours(found, faces, per_face, colours.get("vertex"))
            return vertices, faces
    raise MeshError("has no faces: it is a point cloud, or not made of triangles")


def read_vertices(data: bytes) -> np.ndarray:
    """[V, 3] float64: the vertices alone, of a point cloud or of a mesh."""
    for element, columns in _elements(data):
        if element.name == "vertex":
            return _vertices(columns)
    raise MeshError("has no vertices")


def _elements(data: bytes) -> Iterator[tuple[_Element, dict]]:
    """Each element with its columns."""
    elements, body = _parse_header(data)
    counts = {element.name: element.count for element in elements}
    check_counts(max(counts.values(), default=0), counts.get("face", 0))
    offset = 0
    for element in elements:
        columns, offset = _read_element(element, body, offset)
        yield element, columns


def _vertices(columns: dict) -> np.ndarray:
    names = [axis if axis in columns else axis.upper() for axis in "xyz"]
    if missing := [name.lower() for name in names if name not in columns]:
        raise MeshError(f"has vertices without {', '.join(missing)}")
    if lists := [name for name in names if isinstance(columns[name], tuple)]:
        raise MeshError(f"has vertices with lists of {', '.join(lists)}")
    return np.stack([columns[name] for name in names], axis=1).astype(np.float64)


def _parse_header(data: bytes) -> tuple[list[_Element], bytes]:
    """Elements, and the data behind the header; text becomes binary of float64."""
    end = _END.search(data, 0, _MAX_HEADER_BYTES)
    if end is None or not data.startswith(b"ply"):
        raise MeshError("is not a PLY file, or cut within its header")
    lines = [line.split() for line in data[: end.start()].decode("latin-1").splitlines()]
    order = None
    elements: list[_Element] = []
    for words in lines[1:]:
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", str(name), _] if name in _BYTE_ORDERS:
                order = _BYTE_ORDERS[name]
                text = name == "ascii"
            case ["element", name, count] if count.isdigit() and len(count) <= 12 and order:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count, kind, name] if elements and order:
                elements[-1].properties.append(
                    _Property(name, *_dtypes(kind, order, text), _dtypes(count, order, text)[1])
                )
            case ["property", kind, name] if elements and order:
                elements[-1].properties.append(_Property(name, *_dtypes(kind, order, text), None))
            case _:
                raise MeshError(f"has a header line that PLY does not know: {' '.join(words)!r}")
    if order is None:
        raise MeshError("has a header without the line format")
    body = data[end.end() :]
    return elements, numbers(body).astype("<f8").tobytes() if text else body


def _dtypes(kind: str, order: str, text: bool) -> tuple[np.dtype, np.dtype]:
    """The type that a word of the header means, and the one in which its numbers are read."""
    if kind not in _TYPES:
        raise MeshError(f"has a property of the unknown type {kind!r}")
    meant = np.dtype(order + _TYPES[kind])
    return meant, np.dtype("<f8") if text else meant


def _read_element(element: _Element, body: bytes, offset: int) -> tuple[dict, int]:
    """Columns by name, lists as (sizes [N], items [sum(sizes)]); and the offset behind.

    Most files have lists of the same length in all rows: that of the first row is tried.
    """
    fields: list[tuple] = []
    sizes: dict[int, int] = {}  # of the lists in the first row
    place = offset
    for i, prop in enumerate(element.properties):
        size = 1
        if prop.count_dtype is not None:
            size = sizes[i] = _size(element, prop.count_dtype, body, place) if element.count else 0
            fields.append((f"n{i}", prop.count_dtype))
            place += prop.count_dtype.itemsize
        fields.append((f"p{i}", prop.dtype, (size,)) if i in sizes else (f"p{i}", prop.dtype))
        place += size * prop.dtype.itemsize
    row = np.dtype(fields)
    end = offset + element.count * row.itemsize
    if end <= len(body):
        table = np.frombuffer(body, row, element.count, offset)
        if all((table[f"n{i}"] == size).all() for i, size in sizes.items()):
            columns: dict[str, Any] = {}
            for i, prop in enumerate(element.properties):
                items: Any = table[f"p{i}"]
                if i in sizes:
                    items = np.full(element.count, sizes[i]), items.reshape(-1)
                columns[prop.name] = items
            return columns, end
    if not sizes:
        raise _truncated(element)
    return _read_ragged(element, body, offset)


def _read_ragged(element: _Element, body: bytes, offset: int) -> tuple[dict, int]:
    """Row by row; only lists are kept: the scalars next to them are not needed."""
    least = sum((p.count_dtype or p.dtype).itemsize for p in element.properties)
    if offset + element.count * least > len(body):
        raise _truncated(element)
    lists = sum(p.count_dtype is not None for p in element.properties)
    check_memory(120 * element.count * lists + 30 * len(body), "", MeshMemoryError)
    starts: dict[str, list[int]] = {p.name: [] for p in element.properties if p.count_dtype}
    sizes: dict[str, list[int]] = {name: [] for name in starts}
    for _ in range(element.count):
        for prop in element.properties:
            if prop.count_dtype is None:
                offset += prop.dtype.itemsize
                continue
            size = _size(element, prop.count_dtype, body, offset)
            offset += prop.count_dtype.itemsize
            starts[prop.name].append(offset)
            sizes[prop.name].append(size)
            offset += size * prop.dtype.itemsize
    if offset > len(body):
        raise _truncated(element)
    data = np.frombuffer(body, np.uint8)
    columns = {}
    for prop in element.properties:
        if prop.count_dtype is not None:
            counts = np.array(sizes[prop.name], dtype=np.int64)
            columns[prop.name] = counts, _gather(data, starts[prop.name], counts, prop.dtype)
    return columns, offset


def _gather(data: np.ndarray, starts: list[int], counts: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Items of lists that begin at the bytes `starts`."""
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    first = np.repeat(np.array(starts, dtype=np.int64), counts) + within * dtype.itemsize
    return data[first[:, None] + np.arange(dtype.itemsize)].reshape(-1).view(dtype)


def _size(element: _Element, dtype: np.dtype, body: bytes, offset: int) -> int:
    if offset + dtype.itemsize > len(body):
        raise _truncated(element)
    size = float(np.frombuffer(body, dtype, 1, offset)[0])
    if not (0 <= size <= len(body) and size == int(size)):
        raise MeshError(f"has a list of {size:g} items in element {element.name!r}")
    return int(size)


def _truncated(element: _Element) -> MeshError:
    return MeshError(f"is truncated: not all {element.count} of element {element.name!r} are there")
