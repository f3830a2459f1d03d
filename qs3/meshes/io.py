"""Read one CAD file as a `Mesh`, or say what is wrong with it.

trimesh reads STL, glTF, COLLADA and 3MF. OFF, OBJ and PLY are read here, because trimesh 5.2 gives
other triangles or none: see the modules of `qs3.meshes.formats`, which say what and why.

Files are untrusted: sizes are limited, nothing outside of the file's folder is opened, and
whatever a reader stumbles over becomes a MeshError that names the file.

Axes and units are the file's own, with one exception: glTF, COLLADA and 3MF say which axis is up,
so their meshes are turned to z up (and COLLADA's and 3MF's are scaled to metres). Of the other
formats the caller says it.
"""

from __future__ import annotations

import errno
import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from qs3.config.checks import check_choice
from qs3.errors import MeshError, MeshMemoryError, MeshUnavailableError
from qs3.meshes.finishes import FoundFinishes
from qs3.meshes.formats import collada, gltf, mtl, obj, off, ply, stl, threemf
from qs3.meshes.formats.arrays import Y_UP_TO_Z_UP, Triangles, check_counts, without_strays
from qs3.meshes.formats.colliders import Colliders
from qs3.meshes.mesh import Mesh
from qs3.utils.memory import check_memory

log = logging.getLogger(__name__)

_READERS: dict[str, Callable[[bytes, Path, Colliders, FoundFinishes | None], Triangles]] = {
    ".off": lambda data, *_: off.read(data),
    ".obj": lambda data, folder, _, found: _read_obj(data, folder, found),
    ".ply": lambda data, _, __, found: ply.read(data, found),
    ".stl": lambda data, *_: stl.read(data),
    ".glb": gltf.read_glb,
    ".gltf": gltf.read_gltf,
    ".dae": lambda data, _, colliders, __: collada.read(data, colliders),
    ".3mf": lambda data, _, colliders, __: threemf.read(data, colliders),
}

_PEAK = {".off": 4, ".stl": 7, ".obj": 10, ".ply": 10, ".dae": 10, ".glb": 12, ".gltf": 12}
"""Peak memory over a file's size, as measured with 330,000 triangles; 3MF knows its own."""

# Errors of the system that a file can cause by itself: a decoder's, and a name in it that none has.
_BY_THE_FILE = (None, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL, errno.ENOTDIR)
_PLY_HEADER = 1 << 16  # bytes that its header is looked for in
SUFFIXES: tuple[str, ...] = tuple(_READERS)
"""Suffixes of the files that `load_mesh` reads, in lower case."""


DECLARE_UP = (".glb", ".gltf", ".dae", ".3mf")
"""Those of files that say which axis is up, or whose standard does."""

AXES = ("z", "y")
"""Which axis may be up in the other files."""


def is_mesh(path: Path) -> bool:
    """Whether a file has a surface, by its name; of a PLY, which may hold points, by its header."""
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in SUFFIXES
    try:
        with open(path, "rb") as file:
            header = file.read(_PLY_HEADER).partition(b"end_header")[0]
    except OSError:
        return False  # said when it is read
    return re.search(rb"^element\s+face\s+[1-9]", header, re.MULTILINE) is not None


def load_mesh(
    path: str | Path, keep_colliders: bool = False, up: str = "z", materials: bool = False
) -> Mesh:
    """Read a mesh; polygons are cut into triangles, the parts of a scene are put together.

    Duplicate faces and faces of either orientation are accepted, and vertices are not merged;
    those that no face uses are left out.

    Args:
        path: of a file with one of `SUFFIXES`, in any case.
        keep_colliders: keep a scene's nodes that stand for collisions and that nobody sees (see
            `qs3.meshes.formats.colliders`); else they are left out, and counted in the mesh.
        up: one of `AXES`, which is up in a file that does not say (not of `DECLARE_UP`); "y" is
            turned to z up, (x, y, z) -> (x, -z, y).
        materials: also read what glTF, OBJ (its .mtl files) and PLY (its colours) say of their
            faces, as `Mesh.finishes`; the other formats say nothing that is read.

    Raises:
        MeshError: the file is empty, truncated or damaged, or holds no surface; the message names
            the file and the reason.
        MeshMemoryError: it is too large, for the machine or for `QS3_MEMORY_GB`.
        MeshUnavailableError: it is not there, or its disk does not give it.
    """
    check_choice("up", up, AXES)
    path, colliders = Path(path), Colliders(skip=not keep_colliders)
    found = FoundFinishes() if materials else None
    try:
        with np.errstate(all="ignore"):  # what is not finite is found and named below
            vertices, faces = _read(path, colliders, found)
            if up == "y" and path.suffix.lower() not in DECLARE_UP:
                vertices = vertices @ Y_UP_TO_Z_UP.T
            for note in colliders.notes + ([] if found is None else found.notes):
                log.warning("%s: %s", path, note)
            mesh = _checked(vertices, faces, colliders)
            return mesh if found is None else replace(mesh, finishes=found.of(len(mesh.faces)))
    except (MeshMemoryError, MeshUnavailableError) as error:
        raise type(error)(f"{path}: {error}") from error
    except MeshError as error:
        raise MeshError(f"{path}: {error}. Export the mesh again or remove the file") from error
    except MemoryError as error:
        raise MeshMemoryError(f"{path}: is too large for this machine's memory") from error
    except OSError as error:
        if error.errno in _BY_THE_FILE:
            raise _unreadable(path, error) from error
        raise MeshUnavailableError(f"{path}: cannot be read now ({error.strerror})") from error
    except Exception as error:  # what a reader raises on damaged bytes cannot be listed
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> MeshError:
    return MeshError(
        f"{path}: cannot be read as {path.suffix[1:].upper()} "
        f"({type(error).__name__}: {error}). Export the mesh again or remove the file"
    )


def _read(path: Path, colliders: Colliders, found: FoundFinishes | None) -> Triangles:
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise MeshError(f"is not of a known format ({', '.join(SUFFIXES)})")
    if not path.is_file():
        raise MeshUnavailableError("is not a file" if path.exists() else "does not exist")
    size = path.stat().st_size
    if size == 0:
        raise MeshError("is empty")
    check_memory(_PEAK.get(path.suffix.lower(), 1) * size, "", MeshMemoryError)
    return reader(path.read_bytes(), path.parent, colliders, found)


def _read_obj(data: bytes, folder: Path, found: FoundFinishes | None) -> Triangles:
    if found is not None:
        mtl.read_finishes(data, folder, found)
    return obj.read(data)


def _checked(vertices: np.ndarray, faces: np.ndarray, colliders: Colliders) -> Mesh:
    if len(faces) == 0:
        raise MeshError(f"has no faces{colliders.exception}")
    check_counts(len(vertices), len(faces))
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(vertices):  # before Mesh makes them 32 bits wide
        bad = low if low < 0 else high
        raise MeshError(f"has a face with vertex {bad}, but there are {len(vertices)} vertices")
    mesh = Mesh(*without_strays(vertices, faces), colliders.count)
    if not _has_area(mesh):
        raise MeshError("has no surface: all its faces have zero area")
    return mesh


def _has_area(mesh: Mesh, chunk: int = 100_000) -> bool:
    """Whether any face is more than a line, measured by the mesh's own size."""
    low, high = mesh.bounds
    size = float((high - low).max())
    if not np.isfinite(size):
        raise MeshError("has coordinates too large to compute with")
    for start in range(0, len(mesh.faces), chunk):
        corners = (mesh.vertices[mesh.faces[start : start + chunk]] - low) / (size or 1.0)
        sides = corners[:, 1:] - corners[:, :1]  # [n, 2, 3]
        doubled = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        if (doubled > 1e-12).any():
            return True
    return False
