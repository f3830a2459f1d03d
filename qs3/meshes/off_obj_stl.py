"""OFF, the format of ModelNet; Wavefront OBJ; and STL.

trimesh 5.2 gives other triangles of them, silently:

- OFF: it reads a file whose last faces were cut off, and crashes on a pentagon or a larger polygon
  beside any other (http://www.geomview.org/docs/html/OFF.html).
- OBJ: it takes indices relative to the end of the list so far ("f -3 -2 -1") as relative to the end
  of the file. The format has no counts, so a file that was cut between two faces is not noticed.
- STL, which it reads: it leaves out what is damaged in a text, as a solid without its end.
"""

from __future__ import annotations

import io
import re
from collections import Counter

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.polygons import Triangles, lines, numbers, triangulated, whole

_HEADER = re.compile(rb"\s*((?:ST)?C?N?)(4?n?)OFF[ \t]*(BINARY)?")
_COUNTS = re.compile(rb"\s*(\d{1,12})[ \t]+(\d{1,12})(?:[ \t]+-?\d{1,12})?(?=\s|$)")
_STL_WORDS = re.compile(rb"(?m)^[ \t]*(endfacet|vertex|endloop)\b")


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
