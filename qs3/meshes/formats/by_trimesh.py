"""What trimesh's loaders read, as one mesh in the order of the file.

The loaders are called without `trimesh.load`, which merges vertices (of COLLADA always), rounds
matrices that are nearly rigid and turns the faces of mirrored parts round. Below it the arrays and
the graph are those of the file.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.formats.arrays import Triangles, joined, transformed, used_part

MAX_PARTS = 100_000


def loaded(kind: str, data: bytes, **options: Any) -> dict[str, Any]:
    """What trimesh's loader of the file type `kind` makes of `data`; it opens no other file."""
    from trimesh.exchange.load import mesh_loaders

    with warnings.catch_warnings():
        # By this warning alone numpy says that it has met text and read no further.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return mesh_loaders[kind](file_obj=io.BytesIO(data), **options)
        except AssertionError as error:  # says nothing of its own
            raise MeshError("is truncated or damaged: what it promises is not there") from error


def assembled(
    found: Mapping[str, Any],
    placed: Callable[[str, int], None] = lambda name, faces: None,
) -> Triangles:
    """The mesh of what `loaded` returned: all instances of its parts, put into the world.

    `placed` is told the name and the number of faces of each instance, in their order.
    """
    return joined(_parts(found, placed))


def _parts(found: Mapping[str, Any], placed: Callable[[str, int], None]) -> Iterator[Triangles]:
    shapes = found["geometry"]
    world = {"world": np.eye(4)}
    for edge in found["graph"]:
        name, frame = edge.get("geometry"), str(edge["frame_to"])
        matrix = world[edge.get("frame_from", "world")] @ np.asarray(edge["matrix"], np.float64)
        world[frame] = matrix
        if name is None:
            continue
        shape = shapes[name]
        if len(shape.get("faces", ())):
            part = used_part(np.asarray(shape["vertices"]), np.asarray(shape["faces"], np.int64))
            placed(name, len(part[1]))
            yield transformed(part, matrix)


def check_instances(children: Mapping[str, list[str]], root: str) -> None:
    """Raise MeshError where parts hold themselves, or unfold into more than MAX_PARTS.

    Args:
        children: the parts that each part instances; one that is instanced twice is there twice.
        root: where to start.
    """
    known: dict[str, int] = {}

    def parts(name: str) -> int:
        if known.setdefault(name, 0) == 0:
            known[name] = -1  # being counted
            known[name] = 1 + sum(map(parts, children.get(name, ())))
        if not 0 < known[name] <= MAX_PARTS:
            raise MeshError(f"has more than {MAX_PARTS} parts, or parts within themselves")
        return known[name]

    parts(root)
