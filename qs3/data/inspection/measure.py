"""All that is measured on one domain, and on two beside each other, as plain values."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from qs3.data.inspection import gap, measures
from qs3.data.inspection.columns import columns
from qs3.data.inspection.gravity import judge_set
from qs3.data.inspection.open_dataset import Opened
from qs3.data.inspection.surface import distance_to_mesh, surface_points, surfaces_of
from qs3.errors import ConfigError
from qs3.geometry.sampling import unit_ball

NET_POINTS = 1024
"""Two domains are compared with so many points a cloud, by farthest point sampling."""

WITHIN = 0.1
"""A point of the surface counts as measured with a point so near, in units of the unit ball."""

_FEATURED = 60  # clouds a class for the distance of the distributions
_SURFACE_POINTS = 512  # of each of them, at random
_SURFACES = 20  # objects a class whose distance to the surface is measured

Numbers = dict[str, Any]


@dataclass(frozen=True)
class Bounds:
    """How much is looked at.

    Attributes:
        sample: clouds, for what is measured cloud by cloud; drawn with `seed`.
        seed: of all draws.
        meshes: the folder that a store was generated from, if it was one.
    """

    sample: int = 3000
    seed: int = 0
    meshes: Path | None = None


Advance = Callable[[], None]


def inspect(opened: Opened, bounds: Bounds, advance: Advance = lambda: None) -> Numbers:
    """Everything about one domain; `advance` is called `steps(opened, bounds)` times."""
    data = opened.data
    chosen = measures.chosen_clouds(data, bounds.sample, bounds.seed)
    values = measures.spacing([np.asarray(data.points[i]) for i in chosen], advance)
    return {
        "domain": opened.label,
        "folder": str(opened.folder),
        "variant": opened.variant,
        "sha256": data.sha256,
        "points": int(data.points.shape[1]),
        "looked_at": len(chosen),
        "seed": bounds.seed,
        "counts": measures.counts(data),
        "valid_points": measures.valid_points(opened.rows, data.points.shape[1]),
        "extents": measures.extents(data, chosen),
        "gravity": gravity(opened, bounds.seed),
        "spacing": measures.summary(values, measures.groups(data, chosen)),
        "copies": measures.copies(data, opened.rows),
        "columns": columns(opened.rows, data.meta),
    }


def gravity(opened: Opened, seed: int) -> Numbers:
    """Which way is up by class, and which classes contradict z."""
    data = opened.data
    verdicts = judge_set(data.points, data.labels, data.classes, seed=seed)
    return {
        "by_class": {v.cls: dataclasses.asdict(v) for v in verdicts},
        "contradicting": [v.cls for v in verdicts if v.contradicts()],
        "open_sign": [v.cls for v in verdicts if v.axis_sure and not v.sign_sure],
        "open_axis": [v.cls for v in verdicts if not v.axis_sure],
    }


def compare(a: Opened, b: Opened, bounds: Bounds, advance: Advance = lambda: None) -> Numbers:
    """Two domains beside each other; `advance` is called once a step of `COMPARE_STEPS`.

    Raises:
        ConfigError: they have no class in common.
    """
    common = [cls for cls in a.data.classes if _has(a, cls) and _has(b, cls)]
    if not common:
        raise ConfigError(f"{a.label} and {b.label} have no class in common")
    count = min(NET_POINTS, a.data.points.shape[1], b.data.points.shape[1])
    found: Numbers = {
        "a": a.label,
        "b": b.label,
        "points": count,
        "seed": bounds.seed,
        "within": WITHIN,
        "prior": gap.priors(a.data, b.data),
    }
    clouds, labels, values = {}, {}, {}
    for side, opened in (("a", a), ("b", b)):
        chosen = _of_each(opened, common, _FEATURED, bounds.seed)
        labels[side] = np.repeat(np.arange(len(common)), [len(of) for of in chosen])
        rows = np.concatenate(chosen)
        clouds[side] = [gap.sampled(opened.data.points[i], count) for i in rows]
        advance()
        values[side] = measures.spacing(clouds[side])
        members = {cls: np.flatnonzero(labels[side] == k) for k, cls in enumerate(common)}
        found[f"cloud_{side}"] = measures.summary(values[side], members)
        found[f"extents_{side}"] = measures.extents(opened.data, rows)
        found[f"gravity_{side}"] = gravity(opened, bounds.seed)
        advance()
        found[f"surface_{side}"] = surface(opened, common, bounds)
        advance()
    found["told_apart"] = _told_apart(clouds, labels, values, len(common))
    advance()
    return found


COMPARE_STEPS = 7


def surface(opened: Opened, classes: list[str], bounds: Bounds) -> Numbers:
    """How far points lie from the true surface and how much of it was measured, by class.

    The truth is the placed mesh; where that is not known, the clean twin, whose own spacing is
    then part of every distance; where there is none, only a reason is given.
    """
    surfaces, reason = surfaces_of(dict(opened.data.meta), bounds.meshes)
    twin = opened.twin if surfaces is None else None
    if surfaces is None and twin is None:
        return {"truth": "unknown", "reason": reason}
    rng = np.random.default_rng([bounds.seed, 1])
    kept, by_class = opened.kept, {}
    everything: list[np.ndarray] = []
    for cls, chosen in zip(classes, _of_each(opened, classes, _SURFACES, bounds.seed), strict=True):
        off, relative, measured = [], [], []
        for i in chosen:
            cloud = np.asarray(opened.data.points[i], dtype=np.float64)
            if surfaces is not None:
                mesh = surfaces.mesh(kept[i])
                if mesh is None:
                    continue
                some = rng.permutation(len(cloud))[:_SURFACE_POINTS]
                distance = distance_to_mesh(cloud[some], mesh, rng)
                truth = surface_points(mesh, 4096, rng)
            else:
                assert twin is not None
                truth = np.asarray(twin.points[i], dtype=np.float64)
                distance = cKDTree(truth).query(cloud)[0]
            radius = float(np.linalg.norm(truth - truth.mean(axis=0), axis=1).max()) or 1.0
            off.append(distance)
            relative.append(distance / radius)
            measured.append((cKDTree(cloud).query(truth)[0] < WITHIN * radius).mean())
        if off:
            everything += [np.stack([np.concatenate(off), np.concatenate(relative)])]
            by_class[cls] = {"objects": len(off), **_quantiles(everything[-1])}
            by_class[cls]["measured"] = float(np.mean(measured))
    if not by_class:
        return {"truth": "unknown", "reason": "the meshes are not the ones that were scanned"}
    return {
        "truth": "mesh" if surfaces is not None else "clean twin",
        "all": {
            **_quantiles(np.concatenate(everything, axis=1)),
            "measured": float(np.mean([of["measured"] for of in by_class.values()])),
        },
        "by_class": by_class,
    }


def _quantiles(off: np.ndarray) -> Numbers:
    """Of [2, n] distances: as stored, and in units of the unit ball."""
    median, high = np.percentile(off, [50, 95], axis=1)
    return {
        "median": float(median[0]),
        "p95": float(high[0]),
        "median_ball": float(median[1]),
        "p95_ball": float(high[1]),
    }


def _told_apart(
    clouds: dict[str, list[np.ndarray]],
    labels: dict[str, np.ndarray],
    values: dict[str, dict[str, np.ndarray]],
    classes: int,
) -> Numbers:
    """`gap.nearest_neighbour` of equally many clouds of each class from both sides."""
    named = ("nn_median", "nn_variation", "voxel_variation", "directions", "below", "lonely")
    sides = []
    for side in "ab":
        rows: list[int] = []
        for k in range(classes):
            equal = min(int((labels[s] == k).sum()) for s in "ab")
            rows += np.flatnonzero(labels[side] == k)[:equal].tolist()
        few = min(len(clouds[side][i]) for i in rows)
        more = np.stack([values[side][key][rows] for key in named], axis=1)
        stacked = unit_ball(np.stack([clouds[side][i][:few] for i in rows]))
        sides.append((gap.features(stacked, more), len(named)))
    (a, extra), (b, _) = sides
    return {
        "clouds": len(a),
        "all": gap.nearest_neighbour(a, b),
        "shape": gap.nearest_neighbour(a[:, :-extra], b[:, :-extra]),
        "density": gap.nearest_neighbour(a[:, -extra:], b[:, -extra:]),
    }


def _has(opened: Opened, cls: str) -> bool:
    data = opened.data
    return cls in data.classes and bool(np.any(data.labels == data.classes.index(cls)))


def _of_each(opened: Opened, classes: list[str], limit: int, seed: int) -> list[np.ndarray]:
    """For each class up to `limit` rows, the same ones for every limit's beginning."""
    data, found = opened.data, []
    for cls in classes:
        label = data.classes.index(cls)
        rng = np.random.default_rng([seed, 2, label])
        found.append(rng.permutation(np.flatnonzero(data.labels == label))[:limit])
    return found
