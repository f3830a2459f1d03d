"""OFF, the format of ModelNet, with its variants of the first line.

trimesh 5.2 is not used here: it reads a file whose last faces were cut off without a word, and
crashes on a pentagon or a larger polygon beside any other. Triangles with quads it reads correctly,
with the quads' faces last. It takes "4OFF" for OFF, and needs about six times as long.

http://www.geomview.org/docs/html/OFF.html
"""

from __future__ import annotations

import re

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.formats.arrays import Triangles, check_counts, lines, numbers, whole
from qs3.meshes.formats.polygons import triangulated
from qs3.utils.plural import counted

_HEADER = re.compile(rb"\s*((?:ST)?C?N?)(4?n?)OFF[ \t]*(BINARY)?")
_COUNTS = re.compile(rb"\s*(\d{1,12})[ \t]+(\d{1,12})(?:[ \t]+-?\d{1,12})?(?=\s|$)")


def read(data: bytes) -> Triangles:
    """Read text OFF; colours, normals and texture coordinates are left out.

    ModelNet40 joins header and counts in some files ("OFF490 518 0"); that is read, too.
    """
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"#" in data:
        data = re.sub(rb"#[^\r\n]*", b"", data)
    header = _HEADER.match(data)
    if header is None:
        raise MeshError("is not an OFF file: it does not begin with OFF")
    extras, dimensions, binary = header.groups()
    if dimensions or binary:
        raise MeshError("is a binary or four-dimensional OFF, which is not read")
    counts = _COUNTS.match(data, header.end())
    if counts is None:
        raise MeshError("has no line with the numbers of vertices and faces")
    vertex_count, face_count = int(counts[1]), int(counts[2])
    check_counts(vertex_count, face_count)
    body = data[counts.end() :]
    if not extras:
        mesh = _plain_triangles(body, vertex_count, face_count)
        if mesh is not None:
            return mesh
    return _by_lines(body, vertex_count, face_count)


def _plain_triangles(body: bytes, vertex_count: int, face_count: int) -> Triangles | None:
    """The common case, in one piece: three numbers a vertex, "3 i j k" a face."""
    values = numbers(body)
    split = 3 * vertex_count
    if len(values) != split + 4 * face_count:
        return None
    faces = values[split:].reshape(face_count, 4)
    if (faces[:, 0] != 3).any():
        return None
    return values[:split].reshape(vertex_count, 3), whole(faces[:, 1:], "a vertex index")


def _by_lines(body: bytes, vertex_count: int, face_count: int) -> Triangles:
    """Polygons of several sizes, colours: read line by line."""
    rows = [line for line in lines(body) if not line.isspace()]
    if len(rows) < vertex_count + face_count:
        raise MeshError(
            f"is truncated: {vertex_count} vertices and {face_count} faces were promised, "
            f"{counted(len(rows), 'line is', 'lines are')} there"
        )
    if len(rows) > vertex_count + face_count:  # of what? A vertex could pass for a face
        raise MeshError(
            f"has {len(rows)} lines behind its header, which promises {vertex_count} vertices and "
            f"{face_count} faces"
        )
    columns = [row.split(None, 3)[:3] for row in rows[:vertex_count]]
    coordinates = numbers(b" ".join(token for row in columns for token in row))
    if len(coordinates) != 3 * vertex_count:
        raise MeshError("has a vertex with fewer than three coordinates")
    sizes, corners = [], []
    for row in rows[vertex_count : vertex_count + face_count]:
        tokens = row.split()
        size = int(tokens[0]) if tokens[0].isdigit() else -1
        if not 0 <= size < len(tokens):
            raise MeshError(f"has a broken face line: {row[:60].decode('ascii', 'replace')!r}")
        sizes.append(size)
        corners += tokens[1 : size + 1]
    flat = whole(numbers(b" ".join(corners)), "a vertex index")
    vertices = coordinates.reshape(vertex_count, 3)
    return vertices, triangulated(vertices, np.array(sizes, dtype=np.int64), flat)
