"""What the readers share: numbers from text, polygons to triangles, and the limit."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Iterator

import numpy as np

from qs3.errors import MeshError

MAX_FACES = 20_000_000
MAX_VERTICES = 3 * MAX_FACES

Triangles = tuple[np.ndarray, np.ndarray]
"""Vertices [V, 3] float64 and faces [F, 3] int64; indices are not checked yet."""

Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def lines(data: bytes) -> Iterator[bytes]:
    """Lines one by one, whatever ends them: a list of all takes several times the file.

    Without the byte order mark that some editors put before the first.
    """
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    return iter(io.BytesIO(data))


def numbers(text: bytes) -> np.ndarray:
    """All numbers of a text that holds nothing but numbers and white space, as float64."""
    if not text.strip():
        return np.zeros(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError) as error:
            raise MeshError("holds text where numbers are expected") from error


def whole(values: np.ndarray, what: str) -> np.ndarray:
    """Float64 `values` as int64; MeshError if one is not a whole number."""
    if not (np.abs(values) < 2**53).all() or (values != np.trunc(values)).any():
        raise MeshError(f"holds {what} that is not a whole number")
    return values.astype(np.int64)


def check_counts(vertices: int, faces: int) -> None:
    """Raise MeshError above the limits; called before memory is used where a header tells."""
    if faces > MAX_FACES or vertices > MAX_VERTICES:
        raise MeshError(
            f"has {vertices} vertices and {faces} faces, more than the limits of {MAX_VERTICES} "
            f"and {MAX_FACES}: decimate it in a mesh editor"
        )


def fan(sizes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Cut polygons into triangles around their first corner; exact for convex ones.

    `triangulated` does it of others, too.

    Args:
        sizes: [N] number of corners of each polygon; those with fewer than three vanish.
        corners: [sum(sizes)] vertex indices of all polygons.

    Returns:
        [F, 3] int64 triangles in the order of the polygons.
    """
    triangles = np.maximum(sizes - 2, 0)
    check_counts(0, int(triangles.sum()))
    first = np.repeat(np.cumsum(sizes) - sizes, triangles)
    within = np.arange(len(first)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    second = first + within + 1
    return corners[np.stack([first, second, second + 1], axis=1)].astype(np.int64)


def transformed(mesh: Triangles, matrix: np.ndarray) -> Triangles:
    """Apply a 4x4 homogeneous matrix to the vertices."""
    vertices, faces = mesh
    return vertices @ matrix[:3, :3].T + matrix[:3, 3], faces


def used_part(vertices: np.ndarray, faces: np.ndarray) -> Triangles:
    """Only the vertices that `faces` use: parts often share one long list of vertices."""
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise MeshError(f"has a face with a vertex that is not among {len(vertices)}")
    used, flat = np.unique(faces, return_inverse=True)
    return vertices[used].astype(np.float64), flat.reshape(-1, 3)


def without_strays(vertices: np.ndarray, faces: np.ndarray) -> Triangles:
    """The same without vertices that no face uses; the same arrays where there are none.

    Modelling programs leave some behind. Nobody sees them, but furniture is as large, and shadow
    rays begin as far away, as all vertices say. Where one is not finite the file is damaged, which
    `Mesh` says: then none is left out.
    """
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    whole = used.all() or not np.isfinite(vertices).all()
    return (vertices, faces) if whole else used_part(vertices, faces)


def joined(parts: Iterable[Triangles]) -> Triangles:
    """One mesh of all parts; the limits are checked while they come."""
    vertices, faces = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)]
    vertex_count = face_count = 0
    for part_vertices, part_faces in parts:
        vertices.append(part_vertices)
        faces.append(part_faces + vertex_count)
        vertex_count += len(part_vertices)
        face_count += len(part_faces)
        check_counts(vertex_count, face_count)
    return np.concatenate(vertices), np.concatenate(faces)
