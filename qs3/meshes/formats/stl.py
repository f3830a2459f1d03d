"""STL, binary and text, by trimesh. Corners are kept as they are, three to a triangle.

trimesh leaves out what is damaged in a text (a solid without its end) and stumbles over names of
solids; so the text is counted here, and what trimesh makes of it is compared with that.
"""

from __future__ import annotations

import re

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.formats.arrays import Triangles, check_counts
from qs3.meshes.formats.by_trimesh import loaded

_HEADER, _FACET = 84, 50  # bytes
_NAMES = re.compile(rb"(?im)^[ \t]*(endsolid|solid)\b[^\n]*$")
_KEYWORDS = re.compile(rb"(?im)^[ \t]*(endsolid|solid|endfacet|endloop|vertex)\b")


def read(data: bytes) -> Triangles:
    """Binary if the length is what a binary header promises, else text.

    The first word does not decide: many binary files begin with "solid", too.
    """
    facets = int.from_bytes(data[80:_HEADER], "little")
    if len(data) >= _HEADER and len(data) == _HEADER + _FACET * facets:
        check_counts(3 * facets, facets)
    else:
        data, facets = _plain(data)
    found = loaded("stl", data)
    parts = list(found["geometry"].values()) if "geometry" in found else [found]
    soup = [np.zeros((0, 3)), *(np.asarray(part["vertices"], np.float64) for part in parts)]
    vertices = np.concatenate(soup)
    if len(vertices) != 3 * facets:
        raise MeshError("has a vertex that is not three numbers")
    return vertices, np.arange(len(vertices), dtype=np.int64).reshape(-1, 3)


def _plain(data: bytes) -> tuple[bytes, int]:
    """The text without the names of its solids, and its number of facets."""
    if data.lstrip()[:5].lower() != b"solid":
        raise MeshError("is truncated or not an STL file: its length is not what it promises")
    data = _NAMES.sub(rb"\1", data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")) + b"\n"
    words = [word.lower() for word in _KEYWORDS.findall(data)]
    facets = words.count(b"endfacet")
    check_counts(3 * facets, facets)
    triangle = [*[b"vertex"] * 3, b"endloop", b"endfacet"]
    corners = [word for word in words if word not in (b"solid", b"endsolid")]
    if corners != triangle * facets:
        raise MeshError("is truncated or not an STL file: its facets are not triangles")
    ends = [word for word in words if word in (b"solid", b"endsolid")]
    if ends != [b"solid", b"endsolid"] * (len(ends) // 2) or not words[-1:] == [b"endsolid"]:
        raise MeshError("is truncated or not an STL file: its last endsolid is missing")
    return data, facets
