"""Read one CAD file as a `Mesh`.

Axes and units are the file's own, with one exception: glTF, COLLADA and 3MF state which axis is up,
so their meshes are turned to z up (and COLLADA's and 3MF's are scaled to metres). Of the other
formats the caller states it.
"""

from __future__ import annotations

import errno
import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from qs3.errors import MeshError, MeshUnavailableError
from qs3.meshes.gltf import read_gltf
from qs3.meshes.mesh import Y_UP_TO_Z_UP, Colliders, Mesh, without_strays
from qs3.meshes.off_obj_stl import read_obj, read_off, read_stl
from qs3.meshes.ply import read_ply
from qs3.meshes.polygons import Triangles
from qs3.meshes.xml_scenes import read_3mf, read_collada

log = logging.getLogger(__name__)

_READERS: dict[str, Callable[[bytes, Path, Colliders], Triangles]] = {
    ".off": lambda data, *_: read_off(data),
    ".obj": lambda data, *_: read_obj(data),
    ".ply": lambda data, *_: read_ply(data),
    ".stl": lambda data, *_: read_stl(data),
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".dae": lambda data, _, colliders: read_collada(data, colliders),
    ".3mf": lambda data, _, colliders: read_3mf(data, colliders),
}
SUFFIXES: tuple[str, ...] = tuple(_READERS)
"""Suffixes of the files that `load_mesh` reads, in lower case."""

DECLARE_UP = (".glb", ".gltf", ".dae", ".3mf")
"""Those of files that state which axis is up, or whose standard does."""

Up = Literal["z", "y"]

# Errors of the system that a file can cause by itself: a decoder's, and a name in it that none has.
_BY_THE_FILE = (None, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL, errno.ENOTDIR)
_PLY_HEADER = 1 << 16  # bytes that its header is looked for in


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

    Duplicate faces and faces of either orientation are accepted, and vertices are not merged;
    those that no face uses are left out.

    Args:
        path: of a file with one of `SUFFIXES`, in any case.
        keep_colliders: keep a scene's nodes that stand for collisions and that nobody sees (see
            `qs3.meshes.mesh.Colliders`); else they are left out, and counted in the mesh.
        up: which axis is up in a file that does not state it (not of `DECLARE_UP`); "y" is turned
            to z up, (x, y, z) -> (x, -z, y).

    Raises:
        MeshError: the file is empty, truncated or damaged, or holds no surface; names the file.
        MeshUnavailableError: it is not there, or its disk does not give it.
    """
    path, colliders = Path(path), Colliders(skip=not keep_colliders)
    suffix = path.suffix.lower()
    if not path.is_file():
        raise MeshUnavailableError(f"{path}: is not a file")
    try:
        with np.errstate(all="ignore"):  # what is not finite is found by `Mesh`
            vertices, faces = _READERS[suffix](path.read_bytes(), path.parent, colliders)
            if up == "y" and suffix not in DECLARE_UP:
                vertices = vertices @ Y_UP_TO_Z_UP.T
            mesh = Mesh(*without_strays(vertices, faces), colliders.count)
            if not _has_area(mesh):
                raise MeshError("has no surface: all its faces have zero area")
    except OSError as error:
        if error.errno in _BY_THE_FILE:
            raise _damaged(path, error) from error
        raise MeshUnavailableError(f"{path}: cannot be read now ({error.strerror})") from error
    except Exception as error:  # what a reader raises on damaged bytes cannot be listed
        raise _damaged(path, error) from error
    for note in colliders.notes:
        log.warning("%s: %s", path, note)
    return mesh


def _damaged(path: Path, error: Exception) -> MeshError:
    kind = "" if isinstance(error, MeshError) else f"{type(error).__name__}: "
    return MeshError(f"{path}: cannot be read ({kind}{error})")


def _has_area(mesh: Mesh) -> bool:
    """Whether any face is more than a line, measured by the mesh's own size."""
    low, high = mesh.bounds
    size = float((high - low).max())
    corners = (mesh.vertices[mesh.faces] - low) / (size or 1.0)
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return bool((np.linalg.norm(doubled, axis=1) > 1e-12).any())
