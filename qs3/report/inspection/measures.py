"""What can be measured on one set of clouds: counts, sizes, spacing, copies, density, coverage."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from qs3.geometry.sampling import unit_ball
from qs3.store.manifest import ManifestRow
from qs3.store.store import PointSet

AZIMUTHS, RINGS = 12, 6
"""Directions are counted in 12 x 6 bins of equal solid angle."""

VOXEL = 0.125
"""Side of a voxel in units of the unit ball."""

_OUTLIER = 5.0  # a point is lonely if its 4th neighbour is so many times the cloud's median away
_ODD_SIZE = 5.0  # an object's size is odd so many robust standard deviations from its class
_USUAL = 8  # clouds of a class, to say what is usual: of three one is soon far from the two others

_SPACED = (
    *("nn_low", "nn_median", "nn_high", "nn_variation", "voxel_variation", "lonely"),
    *("directions", "below"),
)

Numbers = dict[str, Any]


def counts(data: PointSet) -> Numbers:
    """Clouds by split and class, and how many have no label."""
    splits = {
        split: {"clouds": len(data.indices(split)), "by_class": by_class}
        for split, by_class in data.counts().items()
    }
    unlabelled = int(np.sum(data.labels < 0))
    return {
        "clouds": len(data),
        "classes": data.classes,
        "unlabelled": unlabelled,
        "splits": splits,
    }


def extents(data: PointSet, chosen: np.ndarray) -> Numbers:
    """Sizes as stored: by class the median of each axis and the range of the largest side."""
    size, low, centroid = (np.empty((len(chosen), 3)) for _ in range(3))
    radius = np.empty(len(chosen))
    for row, i in enumerate(chosen):
        cloud = np.asarray(data.points[i], dtype=np.float64)
        low[row], centroid[row] = cloud.min(axis=0), cloud.mean(axis=0)
        size[row] = cloud.max(axis=0) - low[row]
        radius[row] = np.linalg.norm(cloud - centroid[row], axis=1).max()
    largest = size.max(axis=1)
    odd = []
    by_class = {}
    for name, rows in groups(data, chosen).items():
        logs = np.log(np.maximum(size[rows].max(axis=1), 1e-12))
        spread = max(1.4826 * float(np.median(np.abs(logs - np.median(logs)))), 0.02)
        far = np.abs(logs - np.median(logs)) / spread
        if len(rows) >= _USUAL:
            odd += [
                (float(far[j]), data.ids[chosen[rows[j]]]) for j in np.flatnonzero(far > _ODD_SIZE)
            ]
        by_class[name] = {
            "size_median": np.median(size[rows], axis=0).tolist(),
            "largest_side_min": float(largest[rows].min()),
            "largest_side_max": float(largest[rows].max()),
        }
    return {
        "by_class": by_class,
        "size_median": np.median(size, axis=0).tolist(),
        "in_unit_ball": bool((np.abs(radius - 1) < 1e-3).mean() > 0.99),
        "centroid_offset_median": float(np.median(np.linalg.norm(centroid, axis=1))),
        "floor_median": float(np.median(low[:, 2])),
        "odd_sizes": [name for _, name in sorted(odd, reverse=True)],
    }


def spacing(
    clouds: Sequence[Float[np.ndarray, "p 3"]], advance: Callable[[], None] = lambda: None
) -> dict[str, np.ndarray]:
    """What `one_cloud` gives of each, as arrays [clouds]."""
    rows = []
    for cloud in clouds:
        rows.append(one_cloud(cloud))
        advance()
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def one_cloud(cloud: Float[np.ndarray, "p 3"]) -> dict[str, float]:
    """Spacing, density and coverage of a cloud in the unit ball, copies of a point left out.

    Returns:
        nn_median, nn_low, nn_high: distance to the nearest other point: median, 5 and 95 %.
        nn_variation: its standard deviation over its mean.
        voxel_variation: the same of the points in an occupied voxel.
        copies: share of points that repeat an earlier one exactly.
        lonely: share of points whose 4th neighbour is over five times as far as the median's.
        directions: share of 72 equal bins of direction, from the centroid, with a point in it.
        below: the same for the lowest third of the bins (what a scan from above misses).
        radius: of the cloud as given.
    """
    distinct = np.unique(np.ascontiguousarray(cloud), axis=0)
    whole = {
        "copies": 1 - len(distinct) / len(cloud),
        "radius": float(np.linalg.norm(cloud - cloud.mean(axis=0), axis=1).max()),
    }
    if len(distinct) < 5:
        return {**dict.fromkeys(_SPACED, 0.0), **whole}
    ball = unit_ball(distinct.astype(np.float64))
    nearest, fourth = cKDTree(ball).query(ball, k=[2, 5])[0].T
    _, inside = np.unique(np.floor(ball / VOXEL).astype(int), axis=0, return_counts=True)
    lonely = (fourth > _OUTLIER * np.median(fourth)).mean()
    values = (
        *np.percentile(nearest, [5, 50, 95]),
        nearest.std() / nearest.mean(),
        inside.std() / inside.mean(),
        lonely,
        *_directions(ball),
    )
    return {**dict(zip(_SPACED, map(float, values), strict=True)), **whole}


def _directions(ball: np.ndarray) -> tuple[float, float]:
    """Share of the bins of direction with a point in them: of all, and of the lowest third."""
    norm = np.linalg.norm(ball, axis=1)
    unit = ball[norm > 1e-9] / norm[norm > 1e-9, None]
    azimuth = np.arctan2(unit[:, 1], unit[:, 0]) % (2 * np.pi)
    column = np.minimum((azimuth / (2 * np.pi) * AZIMUTHS).astype(int), AZIMUTHS - 1)
    ring = np.minimum(((unit[:, 2] + 1) / 2 * RINGS).astype(int), RINGS - 1)
    hit = np.zeros((RINGS, AZIMUTHS), dtype=bool)
    hit[ring, column] = True
    return hit.mean(), hit[: RINGS // 3].mean()


def summary(values: Mapping[str, np.ndarray], members: Mapping[str, np.ndarray]) -> Numbers:
    """Medians of what `spacing` gave: over all clouds and by class; means where most are 0."""

    def of(rows: np.ndarray | slice) -> Numbers:
        found = {
            key: float((np.mean if key in ("copies", "lonely") else np.median)(array[rows]))
            for key, array in values.items()
        }
        found["nn_median_raw"] = float(np.median((values["nn_median"] * values["radius"])[rows]))
        return found

    by_class = {name: of(rows) for name, rows in members.items()}
    return {"all": of(slice(None)), "by_class": by_class}


def copies(data: PointSet, rows: Sequence[ManifestRow]) -> Numbers:
    """Clouds that hold the same points, in any order, and meshes used more than once.

    `leaks` are those of them that lie on both sides of train and test.
    """
    clouds: dict[bytes, list[int]] = defaultdict(list)
    for i, points in enumerate(data.points):
        cloud = np.ascontiguousarray(points, dtype="<f4") + np.float32(0)  # no -0
        clouds[hashlib.sha256(cloud[np.lexsort(cloud.T)].tobytes()).digest()].append(i)
    same = [found for found in clouds.values() if len(found) > 1]
    meshes: dict[str, set[str]] = defaultdict(set)
    for row in rows:
        if row.mesh_sha256:
            meshes[row.mesh_sha256].add(row.split)
    return {
        "clouds": sum(len(found) - 1 for found in same),
        "leaks": sum(_leak(data.splits[found]) for found in same),
        "contradicting_labels": sum(len(set(data.labels[found].tolist())) > 1 for found in same),
        "groups": [[data.ids[i] for i in found] for found in same],
        "meshes": len(meshes) or None,
        "leaking_meshes": sum(_leak(splits) for splits in meshes.values()),
    }


def valid_points(rows: Sequence[ManifestRow], points: int) -> Numbers:
    """Points that were measured before a cloud was made of them, and what was left out."""
    known = [
        row.valid_points for row in rows if row.status == "ok" and row.valid_points is not None
    ]
    states = Counter(row.status for row in rows if row.status != "ok")
    return {
        "known": len(known),
        "min": min(known, default=None),
        "median": float(np.median(known)) if known else None,
        "repeating": sum(n < points for n in known),
        "left_out": dict(states),
    }


def chosen_clouds(data: PointSet, limit: int, seed: int) -> np.ndarray:
    """[n] int64: up to `limit` clouds, drawn without replacement, in the dataset's order."""
    if len(data) <= limit:
        return np.arange(len(data))
    return np.sort(np.random.default_rng(seed).permutation(len(data))[:limit])


def groups(data: PointSet, chosen: np.ndarray) -> dict[str, np.ndarray]:
    """Rows of `chosen` by class name; "unlabelled" where no label is known."""
    labels = data.labels[chosen]
    found = {cls: np.flatnonzero(labels == k) for k, cls in enumerate(data.classes)}
    found["unlabelled"] = np.flatnonzero(labels < 0)
    return {name: rows for name, rows in found.items() if len(rows)}


def _leak(splits: Iterable[str]) -> bool:
    found = {str(split) for split in splits}
    return "test" in found and len(found) > 1
