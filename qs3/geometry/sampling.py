"""Points of clouds and surfaces: farthest point sampling, area sampling, the unit ball. Numpy."""

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import DataError, MeshError


def farthest_point_sampling_np(
    points: Float[np.ndarray, "points 3"], n: int, start: int = 0
) -> Int[np.ndarray, " n"]:
    """Indices in the order of farthest point sampling (Eldar et al. 1997), the first is `start`.

    Exact in float32 about the centroid; which of several equally far points is taken first is
    unspecified but always the same. Indices are distinct, copies of taken points come last. With
    n > N the order of all N points starts over.
    """
    from qs3.geometry.farthest_points import farthest  # numba takes a moment to import

    points = np.asarray(points)
    total = len(points)
    assert 0 <= start < total, f"point {start} of {total}"
    if n > total:
        return np.resize(farthest_point_sampling_np(points, total, start), n)
    if n == 0:
        return np.empty(0, dtype=np.int64)
    if not np.isfinite(points).all():
        raise DataError("cannot sample points that are NaN or infinite")
    cloud = np.ascontiguousarray(points - points.mean(axis=0), dtype=np.float32)
    order = farthest(cloud, n, start)
    taken = np.zeros(total, dtype=bool)
    taken[order] = True
    distinct = np.count_nonzero(taken)
    if distinct < n:  # at distance zero one index comes again and again
        order[distinct:] = np.flatnonzero(~taken)[: n - distinct]
    return order


def unit_ball(points: Float[np.ndarray, "*b points 3"]) -> Float[np.ndarray, "*b points 3"]:
    """Clouds about their centroid, the farthest point at distance 1.

    A cloud of one repeated point becomes zeros. The dtype is kept.
    """
    points = np.asarray(points)
    # about the first point: the mean of copies of one point is then that point exactly
    moved = points - points[..., :1, :]
    moved = moved - moved.mean(axis=-2, keepdims=True)
    radius = np.linalg.norm(moved, axis=-1).max(axis=-1)[..., None, None]
    return moved / np.where(radius > 0, radius, 1).astype(points.dtype)


def surface_sample(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    n: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n 3"]:
    """`n` points uniform on the triangles' area, float64; a face without area is never drawn.

    Raises:
        MeshError: the whole surface has no area, or a size that is not finite.
    """
    corners = np.asarray(vertices, dtype=np.float64)[np.asarray(faces)]  # [f, 3 corners, 3]
    edges = corners[:, 1:] - corners[:, :1]  # [f, 2, 3]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    total = np.cumsum(area)
    if len(area) == 0 or not np.isfinite(total[-1]) or not total[-1] > 0:
        raise MeshError(
            f"cannot sample {len(area)} faces of total area {area.sum():g} m²; "
            "check that the mesh is not flat to a line or a point, and finite"
        )
    # side="right": a draw equal to a boundary goes to the face after it, so never to an empty one
    draws = rng.random(n) * total[-1]
    face = np.searchsorted(total, np.minimum(draws, np.nextafter(total[-1], 0)), side="right")
    u, v = rng.random((2, n, 1))
    outside = u + v > 1
    u, v = np.where(outside, 1 - u, u), np.where(outside, 1 - v, v)
    return corners[face, 0] + u * edges[face, 0] + v * edges[face, 1]
