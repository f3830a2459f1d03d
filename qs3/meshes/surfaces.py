"""Files of one surface: OFF, the format of ModelNet; Wavefront OBJ; STL; and PLY.

trimesh 5.2 gives other triangles of them, silently:

- OFF: it reads a file whose last faces were cut off, and crashes on a pentagon or a larger polygon
  next to any other (http://www.geomview.org/docs/html/OFF.html).
- OBJ: it takes indices relative to the end of the list so far ("f -3 -2 -1") as relative to the end
  of the file. The format has no counts, so a file that was cut between two faces is not noticed.
- STL, which it reads: it leaves out what is damaged in a text, as a solid without its end.
- PLY: it divides concave polygons wrongly, and refuses binary files in which triangles and quads
  are mixed, which is what Blender writes.
"""

import io
import re
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.polygons import Triangles, lines, numbers, triangulated, whole

_HEADER = re.compile(rb"\s*((?:ST)?C?N?)(4?n?)OFF[ \t]*(BINARY)?")
_COUNTS = re.compile(rb"\s*(\d{1,12})[ \t]+(\d{1,12})(?:[ \t]+-?\d{1,12})?(?=\s|$)")
_STL_WORDS = re.compile(rb"(?m)^[ \t]*(endfacet|vertex|endloop)\b")
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4"},
    **{"uint32": "u4", "int64": "i8", "uint64": "u8"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_END = re.compile(rb"\bend_header[ \t]*(?:\r\n|\n|\r)")


def read_off(data: bytes) -> Triangles:
    """Read text OFF; colours, normals and texture coordinates are left out.

    ModelNet40 joins header and counts in some files ("OFF490 518 0"); that is read, too.
    """
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"#" in data:
        data = re.sub(rb"#[^\r\n]*", b"", data)
    header = _HEADER.match(data)
    if header is None or header[2] or header[3]:
        raise MeshError("is not a text file of OFF in three dimensions")
    counts = _COUNTS.match(data, header.end())
    assert counts is not None, "has no line with the numbers of vertices and faces"
    vertex_count, face_count = int(counts[1]), int(counts[2])
    body = data[counts.end() :]
    mesh = None if header[1] else _plain_triangles(body, vertex_count, face_count)
    return mesh or _by_lines(body, vertex_count, face_count)


def _plain_triangles(body: bytes, vertex_count: int, face_count: int) -> Triangles | None:
    """The common case, in one piece: three numbers a vertex, "3 i j k" a face."""
    values = numbers(body)
    split = 3 * vertex_count
    if len(values) != split + 4 * face_count:
        return None
    faces = values[split:].reshape(face_count, 4)
    if (faces[:, 0] != 3).any():
        return None
    return values[:split].reshape(vertex_count, 3), whole(faces[:, 1:])


def _by_lines(body: bytes, vertex_count: int, face_count: int) -> Triangles:
    """Polygons of several sizes, colours: read line by line."""
    rows = [line for line in lines(body) if not line.isspace()]
    if len(rows) != vertex_count + face_count:  # of too many a vertex could pass for a face
        raise MeshError(f"has {len(rows)} lines, not {vertex_count} vertices + {face_count} faces")
    columns = [row.split(None, 3)[:3] for row in rows[:vertex_count]]
    vertices = numbers(b" ".join(token for row in columns for token in row))
    vertices = vertices.reshape(vertex_count, 3)
    sizes, corners = [], []
    for row in rows[vertex_count:]:
        tokens = row.split()
        size = int(tokens[0])
        if not 0 <= size < len(tokens):
            raise MeshError("has a broken line of a face")
        sizes.append(size)
        corners += tokens[1 : size + 1]
    flat = whole(numbers(b" ".join(corners)))
    return vertices, triangulated(vertices, np.array(sizes, dtype=np.int64), flat)


def read_obj(data: bytes) -> Triangles:
    """Read all objects and groups of the file as one mesh; no other file is opened."""
    if b"\\" in data:  # a line that goes on in the next one
        data = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    coordinates: list[bytes] = []
    corners: list[int] = []
    sizes: list[int] = []
    for line in lines(data):
        tokens = line.split(b"#", 1)[0].split()
        if not tokens:
            continue
        if tokens[0] == b"v":
            if len(tokens) < 4:
                raise MeshError("has a vertex of fewer than three coordinates")
            coordinates += tokens[1:4]
        elif tokens[0] == b"f":
            sizes.append(len(tokens) - 1)
            corners += [_index(token, len(coordinates) // 3) for token in tokens[1:]]
    vertices = numbers(b" ".join(coordinates)).reshape(-1, 3)
    polygons = np.array(sizes, dtype=np.int64), np.array(corners, dtype=np.int64)
    return vertices, triangulated(vertices, *polygons)


def _index(corner: bytes, vertices_so_far: int) -> int:
    """Zero-based vertex of a corner "v", "v/vt", "v//vn" or "v/vt/vn"."""
    index = int(corner.split(b"/", 1)[0])
    if index == 0 or -index > vertices_so_far:
        raise MeshError(f"has a face with the corner {index}")
    return index - 1 if index > 0 else vertices_so_far + index


def read_stl(data: bytes) -> Triangles:
    """Binary if the length is what a binary header promises, else text; corners stay as they are.

    The first word does not decide: many binary files begin with "solid", too.
    """
    import trimesh

    loaded = trimesh.load_mesh(io.BytesIO(data), file_type="stl", process=False)
    if len(data) != 84 + 50 * int.from_bytes(data[80:84], "little"):
        words = Counter(_STL_WORDS.findall(data.lower()))
        expected = {b"vertex": 3, b"endloop": 1, b"endfacet": 1}
        ends = re.fullmatch(rb"endsolid\b.*", data.lower().strip().splitlines()[-1].strip())
        if not ends or any(words[word] != n * len(loaded.faces) for word, n in expected.items()):
            raise MeshError("is truncated or not an STL file")
    return np.array(loaded.vertices), np.array(loaded.faces)


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
            names = [axis if axis in columns else axis.upper() for axis in "xyz"]
            vertices = np.stack([columns[name] for name in names], axis=1).astype(np.float64)
        elif element.name == "face":
            key = "vertex_indices" if "vertex_indices" in columns else "vertex_index"
            sizes, corners = columns[key]
            polygons = sizes, whole(corners.astype(np.float64))
        if vertices is not None and polygons is not None:
            return vertices, triangulated(vertices, *polygons)
    raise MeshError("has no faces: it is a point cloud, or not made of triangles")


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
    """An element all of whose lists are as long as in the first row, and the offset behind it."""
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
