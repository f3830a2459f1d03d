"""What the readers of mesh files share: numbers from text, and polygons to triangles.

A polygon becomes a fan around its first corner where that is right: always of convex ones. A fan
covers its polygon exactly once if none of its triangles is turned over. The others are cut by their
ears: an ear is a corner whose triangle lies within the polygon (Meisters, 1975). It is looked for
in the plane of two axes that the polygon's normal, by Newell's formula, is farthest from.
"""

import io
import warnings
from collections.abc import Iterator

import numpy as np

from qs3.errors import MeshError

Triangles = tuple[np.ndarray, np.ndarray]
"""Vertices [V, 3] float64 and faces [F, 3] int64; indices are not checked yet."""

_TURNED = 1e-6  # doubled area by the square of the polygon's size: more than float32 rounds
_FLAT = 1e-12  # the same, of a corner that is none

Point = tuple[float, float]


def lines(data: bytes) -> Iterator[bytes]:
    """Lines one by one, whatever ends them, without a byte order mark."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    return iter(io.BytesIO(data))


def numbers(text: bytes | str | None) -> np.ndarray:
    """All numbers of a text that holds nothing but numbers and white space, as float64."""
    if not text or not text.strip():
        return np.zeros(0)
    with warnings.catch_warnings():
        # By this warning alone numpy reports that it met text and read no further.
        warnings.simplefilter("error", DeprecationWarning)
        return np.fromstring(text, dtype=np.float64, sep=" ")


def whole(values: np.ndarray) -> np.ndarray:
    """Float64 `values` as int64; MeshError if one is not a whole number."""
    if not (np.abs(values) < 2**53).all() or (values != np.trunc(values)).any():
        raise MeshError("a vertex index is not a whole number")
    return values.astype(np.int64)


def fan(sizes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Cut polygons into triangles around their first corner; see `triangulated`."""
    triangles = np.maximum(sizes - 2, 0)
    first = np.repeat(np.cumsum(sizes) - sizes, triangles)
    within = np.arange(len(first)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    second = first + within + 1
    return corners[np.stack([first, second, second + 1], axis=1)].astype(np.int64)


def triangulated(vertices: np.ndarray, sizes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Cut polygons into triangles; also concave ones, and those that touch themselves.

    What crosses itself stays a fan, as all polygons do of which a vertex is not there.

    Args:
        vertices: [V, 3] float64.
        sizes: [N] number of corners of each polygon; those with fewer than three vanish.
        corners: [sum(sizes)] vertex indices of all polygons.

    Returns:
        [F, 3] int64 triangles in the order of the polygons, for each its corners less two.
    """
    faces = fan(sizes, corners)
    if not len(faces) or not 0 <= corners.min() <= corners.max() < len(vertices):
        return faces  # `Mesh` finds it
    counts = np.maximum(sizes - 2, 0)
    starts = np.cumsum(counts) - counts
    large = np.flatnonzero(counts > 1)
    for polygon in _wrongly_fanned(vertices, faces, starts[large], counts[large]):
        first, end = starts[large[polygon]], starts[large[polygon]] + counts[large[polygon]]
        outline = [*faces[first, :2], *faces[first:end, 2]]
        ears = _clipped(_flat(vertices[outline]))
        if ears is not None:
            faces[first:end] = np.array(outline)[ears]
    return faces


def _wrongly_fanned(
    vertices: np.ndarray, faces: np.ndarray, starts: np.ndarray, counts: np.ndarray
) -> list[int]:
    """Which of N polygons, by first triangle and number of them, have one that is turned over."""
    if not len(starts):
        return []
    within = np.cumsum(counts) - counts
    owner = np.repeat(np.arange(len(starts)), counts)
    triangles = faces[starts[owner] + np.arange(len(owner)) - within[owner]]
    with np.errstate(all="ignore"):  # what is not finite is found later
        one, two = (vertices[triangles[:, i]] - vertices[triangles[:, 0]] for i in (1, 2))
        cross = np.cross(one, two)
        normal = np.add.reduceat(cross, within)
        longest = np.maximum((one**2).sum(axis=1), (two**2).sum(axis=1))
        limit = _TURNED * np.maximum.reduceat(longest, within)
        length = np.linalg.norm(normal, axis=1)
        upright = (cross * normal[owner]).sum(axis=1)
        turned = upright < -(limit * length)[owner]
        turned &= (length > limit)[owner]
    return np.unique(owner[turned]).tolist()


def _flat(outline: np.ndarray) -> list[Point]:
    """The outline [n, 3] in a plane, counterclockwise, of size one."""
    sides = outline - outline[0]
    normal = np.cross(sides[1:-1], sides[2:]).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    x, y = (axis + 1) % 3, (axis + 2) % 3
    flat = sides[:, [x, y] if normal[axis] > 0 else [y, x]] / np.abs(sides).max()
    return [(float(u), float(v)) for u, v in flat]


def _clipped(points: list[Point]) -> list[list[int]] | None:
    """Triangles [n - 2][3] of a counterclockwise outline; None where it crosses itself."""
    left, ears = list(range(len(points))), []
    at = missed = 0
    strict = True
    while len(left) > 2:
        count = len(left)
        if missed == count:
            if not strict:
                return None
            strict, missed = False, 0  # a corner of no area, or one whose sides are touched
        at %= count
        a, b, c = left[at - 1], left[at], left[(at + 1) % count]
        area = _area(points[a], points[b], points[c])
        fits = area > _FLAT and not _blocked(points, left, (a, b, c), strict)
        if fits or (not strict and abs(area) <= _FLAT):
            ears.append([a, b, c])
            del left[at]
            at, missed, strict = at - 1, 0, True  # the neighbours have changed
            if at < 0:
                at = len(left) - 1
        else:
            at, missed = at + 1, missed + 1
    return ears


def _blocked(points: list[Point], left: list[int], ear: tuple[int, int, int], strict: bool) -> bool:
    """Whether the outline enters the ear; if `strict`, also whether it touches its sides."""
    a, b, c = (points[i] for i in ear)
    lowest = min(a[0], b[0], c[0]), min(a[1], b[1], c[1])
    highest = max(a[0], b[0], c[0]), max(a[1], b[1], c[1])
    for place, index in enumerate(left):
        p = points[index]
        if not (lowest[0] <= p[0] <= highest[0] and lowest[1] <= p[1] <= highest[1]):
            continue
        if index in ear:
            continue
        if p in (a, b, c):
            before, behind = points[left[place - 1]], points[left[(place + 1) % len(left)]]
            one, two = {a: (b, c), b: (c, a), c: (a, b)}[p]
            for way in (before, behind):
                if _area(p, one, way) > _FLAT and _area(p, way, two) > _FLAT:
                    return True
            continue
        inside = min(_area(a, b, p), _area(b, c, p), _area(c, a, p))
        if inside > _FLAT or (strict and inside >= -_FLAT):
            return True
    return False


def _area(a: Point, b: Point, c: Point) -> float:
    """Doubled; positive of a left turn."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
