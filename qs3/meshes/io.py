"""Read one CAD file as a `Mesh`.

Axes and units are the file's own, with one exception: glTF and 3MF state which axis is up, so their
meshes are turned to z up (and 3MF's are scaled to metres).
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from qs3.errors import MeshError, MeshUnavailableError
from qs3.meshes.mesh import Y_UP_TO_Z_UP, Mesh, without_strays
from qs3.meshes.polygons import Triangles
from qs3.meshes.scenes import read_3mf, read_gltf
from qs3.meshes.surfaces import read_obj, read_off, read_ply, read_stl

_SURFACES: dict[str, Callable[[bytes], Triangles]] = {
    **{".off": read_off, ".obj": read_obj, ".ply": read_ply, ".stl": read_stl},
}
_SCENES: dict[str, Callable[[bytes, Path, bool], Mesh]] = {
    **{".glb": read_gltf, ".gltf": read_gltf, ".3mf": read_3mf},
}
SUFFIXES: tuple[str, ...] = (*_SURFACES, *_SCENES)
"""Suffixes of the files that `load_mesh` reads, in lower case."""

DECLARE_UP: tuple[str, ...] = tuple(_SCENES)
"""Those of files that state which axis is up, or whose standard does."""

Up = Literal["z", "y"]

_PLY_HEADER = 1 << 16  # bytes in which its header is searched


def is_mesh(path: Path) -> bool:
    """Whether a file has a surface, by its name; of a PLY, which may hold points, by its header."""
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in SUFFIXES
    try:
        with open(path, "rb") as file:
            header = file.read(_PLY_HEADER).partition(b"end_header")[0]
    except OSError:
        return False  # reading it raises it again
    return re.search(rb"^element\s+face\s+[1-9]", header, re.MULTILINE) is not None


def load_mesh(path: str | Path, keep_colliders: bool = False, up: Up = "z") -> Mesh:
    """Read a mesh; polygons are cut into triangles, the parts of a scene are put together.

    Vertices are not merged; those that no face uses are left out.

    Args:
        path: of a file with one of `SUFFIXES`, in any case.
        keep_colliders: keep a scene's invisible nodes (`qs3.meshes.mesh.is_collider`); else they
            are left out, and counted in the mesh.
        up: which axis is up in a file that does not state it (not of `DECLARE_UP`); "y" is turned
            to z up, (x, y, z) -> (x, -z, y).

    Raises:
        MeshError: the file is empty, truncated or damaged; names the file.
        MeshUnavailableError: it is not there, or its disk does not give it.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MeshUnavailableError(f"{path}: cannot be read now ({error.strerror})") from error
    try:
        with np.errstate(all="ignore"):  # what is not finite is found by `Mesh`
            if suffix in _SCENES:
                return _SCENES[suffix](data, path.parent, keep_colliders)
            vertices, faces = _SURFACES[suffix](data)
            if up == "y":
                vertices = vertices @ Y_UP_TO_Z_UP.T
            return Mesh(*without_strays(vertices, faces))
    except Exception as error:  # what a reader raises on damaged bytes cannot be listed
        kind = "" if isinstance(error, MeshError) else f"{type(error).__name__}: "
        raise MeshError(f"{path}: cannot be read ({kind}{error})") from error
