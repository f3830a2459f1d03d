"""Wavefront OBJ: its vertices and polygons. Materials are read by `mtl`, where they are wanted.

trimesh 5.2 is not used here: it takes indices relative to the end of the list so far ("f -3 -2
-1") as relative to the end of the file, and orders faces by material.

The format has no counts, so a file that was cut between two faces is not noticed.
"""

from __future__ import annotations

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.formats.arrays import Triangles, lines, numbers
from qs3.meshes.formats.polygons import triangulated
from qs3.utils.plural import counted


def read(data: bytes) -> Triangles:
    """Read all objects and groups of the file as one mesh."""
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
                raise MeshError(f"has a vertex with {counted(len(tokens) - 1, 'coordinate')}")
            coordinates += tokens[1:4]
        elif tokens[0] == b"f":
            sizes.append(len(tokens) - 1)
            for token in tokens[1:]:
                corners.append(_index(token, len(coordinates) // 3))
    vertices = numbers(b" ".join(coordinates))
    if len(vertices) != len(coordinates):
        raise MeshError("holds text where coordinates are expected")
    vertices = vertices.reshape(-1, 3)
    polygons = np.array(sizes, dtype=np.int64), np.array(corners, dtype=np.int64)
    return vertices, triangulated(vertices, *polygons)


def _index(corner: bytes, vertices_so_far: int) -> int:
    """Zero-based vertex of a corner "v", "v/vt", "v//vn" or "v/vt/vn"."""
    text = corner.split(b"/", 1)[0]
    try:
        index = int(text)
    except ValueError:
        index = 0
    if index == 0 or -index > vertices_so_far or abs(index) > 2**31:
        raise MeshError(f"has a face with the corner {corner[:40].decode('ascii', 'replace')!r}")
    return index - 1 if index > 0 else vertices_so_far + index
