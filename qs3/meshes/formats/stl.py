"""STL, binary and text. Corners are kept as they are, three to a triangle."""

from __future__ import annotations

import struct

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.formats.arrays import Triangles, check_counts, lines, numbers

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_FACET_KEYWORDS = [b"facet", b"outer", *[b"vertex"] * 3, b"endloop", b"endfacet"]


def read(data: bytes) -> Triangles:
    """Binary if the length is what a binary header promises, else text.

    The first word does not decide: many binary files begin with "solid", too.
    """
    if len(data) >= 84:
        (count,) = struct.unpack_from("<I", data, 80)
        if len(data) == 84 + _FACET.itemsize * count:
            check_counts(3 * count, count)
            return _soup(np.frombuffer(data, _FACET, offset=84)["corners"])
    if not data.lstrip()[:5].lower() == b"solid":
        raise MeshError("is truncated or no STL: its length is not what its header promises")
    return _soup(_text(data))


def _text(data: bytes) -> np.ndarray:
    solids: list[bytes] = []
    corners: list[bytes] = []
    keywords = 0
    for line in lines(data):
        tokens = line.split()
        if not tokens:
            continue
        keyword = tokens[0].lower()
        if keyword in (b"solid", b"endsolid"):
            solids.append(keyword)
            continue
        if keyword != _FACET_KEYWORDS[keywords % len(_FACET_KEYWORDS)]:
            raise MeshError("is truncated or no STL: its facets are not triangles")
        keywords += 1
        if keyword == b"vertex":
            if len(tokens) != 4:
                raise MeshError("has a vertex that is not three numbers")
            corners += tokens[1:]
    if solids != [b"solid", b"endsolid"] * (len(solids) // 2) or keywords % len(_FACET_KEYWORDS):
        raise MeshError("is truncated or no STL: its last facet or endsolid is missing")
    check_counts(len(corners) // 3, len(corners) // 9)
    return numbers(b" ".join(corners))


def _soup(corners: np.ndarray) -> Triangles:
    vertices = corners.reshape(-1, 3).astype(np.float64)
    return vertices, np.arange(len(vertices), dtype=np.int64).reshape(-1, 3)
