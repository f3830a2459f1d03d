"""All that is measured on one domain, and on two side by side, as plain values."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from qs3.errors import ConfigError
from qs3.geometry.sampling import surface_sample, unit_ball
from qs3.report.inspection import gap, measures
from qs3.report.inspection.columns import columns
from qs3.report.inspection.gravity import catalogue_model, judge_set
from qs3.report.inspection.open_dataset import Opened
from qs3.report.inspection.surface import distance_to_mesh, surfaces_of

NET_POINTS = 1024
"""Two domains are compared with so many points a cloud, by farthest point sampling."""

WITHIN = 0.1
"""A point of the surface counts as measured with a point so near, in units of the unit ball."""

COMPARE_STEPS = 5

_FEATURED = 60  # clouds a class that are compared
_SURFACES = 20  # objects a class whose distance to the surface is measured,
_SURFACE_POINTS = 512  # with so many points of each, at random

Numbers = dict[str, Any]
Advance = Callable[[], None]


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


def inspect(opened: Opened, bounds: Bounds, advance: Advance = lambda: None) -> Numbers:
    """Everything about one domain; `advance` is called once a cloud that is measured."""
    data = opened.data
    chosen = measures.chosen_clouds(data, bounds.sample, bounds.seed)
    values = measures.spacing([np.asarray(data.points[i]) for i in chosen], advance)
    views = {row.views for row in opened.kept}
    model = catalogue_model(views=views == {1})
    verdicts = judge_set(data.points, data.labels, data.classes, model, bounds.seed)
    return {
        "domain": opened.label,
        "folder": str(opened.folder),
        "variant": opened.variant,
        "made_of": str(opened.made_of),
        "sha256": data.sha256,
        "points": int(data.points.shape[1]),
        "looked_at": len(chosen),
        "seed": bounds.seed,
        "counts": measures.counts(data),
        "valid_points": measures.valid_points(opened.rows, data.points.shape[1]),
        "extents": measures.extents(data, chosen),
        "gravity": {
            "single_views": None if None in views else model.views,
            "by_class": {v.cls: dataclasses.asdict(v) for v in verdicts},
            "contradicting": [v.cls for v in verdicts if v.contradicts()],
            "confirming": [v.cls for v in verdicts if v.confirms()],
        },
        "spacing": measures.summary(values, measures.groups(data, chosen)),
        "copies": measures.copies(data, opened.rows),
        "columns": columns(opened.rows, data.meta),
    }


def compare(a: Opened, b: Opened, bounds: Bounds, advance: Advance = lambda: None) -> Numbers:
    """The gap between two domains; `advance` is called once a step of `COMPARE_STEPS`.

    Raises:
        ConfigError: they have no class in common.
    """
    common = [
        cls for cls in a.data.classes if a.data.members(cls).size and b.data.members(cls).size
    ]
    if not common:
        bare = " and ".join(one.label for one in (a, b) if (one.data.labels < 0).all())
        why = f": the clouds of {bare} have no labels, and classes are what is compared"
        raise ConfigError(f"{a.label} and {b.label} have no class in common" + why * bool(bare))
    count = min(NET_POINTS, a.data.points.shape[1], b.data.points.shape[1])
    found: Numbers = {
        "a": a.label,
        "b": b.label,
        "made_of_a": str(a.made_of),
        "made_of_b": str(b.made_of),
        "points": count,
        "seed": bounds.seed,
        "within": WITHIN,
        "prior": gap.priors(a.data, b.data),
    }
    clouds, labels, values = {}, {}, {}
    floors = (a.data.floor_m, b.data.floor_m)
    for side, opened in (("a", a), ("b", b)):
        chosen = _of_each(opened, common, _FEATURED, bounds.seed)
        labels[side] = np.repeat(np.arange(len(common)), [len(of) for of in chosen])
        clouds[side] = [gap.sampled(opened.data.points[i], count) for i in np.concatenate(chosen)]
        values[side] = measures.spacing(clouds[side])
        if (floor_m := opened.data.floor_m) is not None and None not in floors:
            found[f"floor_{side}"] = {
                cls: gap.over_the_floor([opened.data.points[i] for i in of], floor_m)
                for cls, of in zip(common, chosen, strict=True)
            }
        found[f"cloud_{side}"] = measures.summary(values[side], {})["all"]
        advance()
        found[f"surface_{side}"] = surface(opened, common, bounds)
        advance()
    found["told_apart"] = _told_apart(clouds, labels, values, len(common))
    advance()
    return found


def surface(opened: Opened, classes: list[str], bounds: Bounds) -> Numbers:
    """How far points lie from the true surface and how much of it was measured.

    The truth is the placed mesh; where that is not known, the clean twin, whose own spacing is
    then part of every distance; where there is none, only a reason is given. Distances are as
    stored, and in units of the unit ball; the measured share is the mean over the classes.
    """
    surfaces, reason = surfaces_of(dict(opened.data.meta), bounds.meshes)
    twin = opened.twin if surfaces is None else None
    if surfaces is None and twin is None:
        return {"truth": "unknown", "reason": reason}
    rng = np.random.default_rng([bounds.seed, 1])
    kept = opened.kept
    off, relative, shares = [], [], []
    for chosen in _of_each(opened, classes, _SURFACES, bounds.seed):
        measured = []
        for i in chosen:
            cloud = np.asarray(opened.data.points[i], dtype=np.float64)
            if surfaces is not None:
                mesh = surfaces.mesh(kept[i])
                if mesh is None:
                    continue
                some = rng.permutation(len(cloud))[:_SURFACE_POINTS]
                distance = distance_to_mesh(cloud[some], mesh, rng)
                truth = surface_sample(mesh.vertices, mesh.faces, 4096, rng)
            else:
                assert twin is not None
                truth = np.asarray(twin.points[i], dtype=np.float64)
                distance = cKDTree(truth).query(cloud)[0]
            radius = float(np.linalg.norm(truth - truth.mean(axis=0), axis=1).max()) or 1.0
            off.append(distance)
            relative.append(distance / radius)
            measured.append((cKDTree(cloud).query(truth)[0] < WITHIN * radius).mean())
        shares += [np.mean(measured)] if measured else []
    if not off:
        return {"truth": "unknown", "reason": "the meshes are not the ones that were scanned"}
    median, p95 = np.percentile([np.concatenate(off), np.concatenate(relative)], [50, 95], axis=1)
    return {
        "truth": "clean twin" if surfaces is None else "mesh",
        "median": float(median[0]),
        "p95": float(p95[0]),
        "median_ball": float(median[1]),
        "p95_ball": float(p95[1]),
        "measured": float(np.mean(shares)),
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
        sides.append(gap.features(stacked, more))
    a, b = sides
    extra = len(named)
    return {
        "clouds": len(a),
        "all": gap.nearest_neighbour(a, b),
        "shape": gap.nearest_neighbour(a[:, :-extra], b[:, :-extra]),
        "density": gap.nearest_neighbour(a[:, -extra:], b[:, -extra:]),
    }


def _of_each(opened: Opened, classes: list[str], limit: int, seed: int) -> list[np.ndarray]:
    """For each class up to `limit` rows, the same ones for every limit's beginning."""
    found = []
    for cls in classes:
        rng = np.random.default_rng([seed, 2, opened.data.classes.index(cls)])
        found.append(rng.permutation(opened.data.members(cls))[:limit])
    return found
