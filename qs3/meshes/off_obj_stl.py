"""OFF, the format of ModelNet; Wavefront OBJ; and STL.

trimesh 5.2 gives other triangles of them, silently:

- OFF: it reads a file whose last faces were cut off, and crashes on a pentagon or a larger polygon
  beside any other (http://www.geomview.org/docs/html/OFF.html).
- OBJ: it takes indices relative to the end of the list so far ("f -3 -2 -1") as relative to the end
  of the file. The format has no counts, so a file that was cut between two faces is not noticed.
- STL: it leaves out what is damaged in a text, as a solid without its end.
"""

from __future__ import annotations

import re

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.polygons import Triangles, lines, numbers, triangulated, whole

_HEADER = re.compile(rb"\s*((?:ST)?C?N?)(4?n?)OFF[ \t]*(BINARY)?")
_COUNTS = re.compile(rb"\s*(\d{1,12})[ \t]+(\d{1,12})(?:[ \t]+-?\d{1,12})?(?=\s|$)")
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER = 84  # bytes
_VERTEX = re.compile(rb"(?im)^[ \t]*vertex[ \t]+(\S+[ \t]+\S+[ \t]+\S+)[ \t]*$")
_STL_WORDS = re.compile(rb"(?im)^[ \t]*(endfacet|vertex|endloop)\b")
_SOLIDS = re.compile(rb"(?im)^[ \t]*(endsolid|solid)\b")


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
    facets = int.from_bytes(data[80:_STL_HEADER], "little")
    if len(data) >= _STL_HEADER and len(data) == _STL_HEADER + _FACET.itemsize * facets:
        vertices = np.frombuffer(data, _FACET, offset=_STL_HEADER)["corners"].astype(np.float64)
    else:
        vertices = numbers(b" ".join(_text_vertices(data)))
    vertices = vertices.reshape(-1, 3)
    return vertices, np.arange(len(vertices), dtype=np.int64).reshape(-1, 3)


def _text_vertices(data: bytes) -> list[bytes]:
    """The three numbers of each vertex; MeshError where one, or the end of a solid, is missing."""
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    words = [word.lower() for word in _STL_WORDS.findall(data)]
    facets = len(words) // 5
    solids = [word.lower() for word in _SOLIDS.findall(data)]
    found = _VERTEX.findall(data)
    if (
        words != [*[b"vertex"] * 3, b"endloop", b"endfacet"] * facets
        or len(found) != 3 * facets
        or solids != [b"solid", b"endsolid"] * (len(solids) // 2)
        or not data.rstrip().rpartition(b"\n")[2].lstrip().lower().startswith(b"endsolid")
    ):
        raise MeshError("is truncated or not an STL file")
    return found
