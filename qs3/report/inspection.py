"""What datasets are like: counts, sizes, spacing, density, coverage, copies, and the gap of two."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.spatial import cKDTree

from qs3.errors import ConfigError
from qs3.geometry.sampling import farthest_point_sampling_np, surface_sample, unit_ball
from qs3.report.datasets import Opened, distance_to_mesh, surfaces_of
from qs3.report.sheets import drawn
from qs3.store.meta import ManifestRow
from qs3.store.store import PointSet
from qs3.utils.page import render
from qs3.utils.progress import progress_bar

NET_POINTS = 1024
"""Two datasets are compared with so many points a cloud, by farthest point sampling."""

WITHIN = 0.1
"""A point of the surface counts as measured with a point so near, in units of the unit ball."""

AZIMUTHS, RINGS = 12, 6
"""Directions are counted in 12 x 6 bins of equal solid angle."""

VOXEL = 0.125
"""Side of a voxel in units of the unit ball."""

_OUTLIER = 5.0  # a point is lonely if its 4th neighbour is so many times the cloud's median away
_ODD_SIZE = 5.0  # an object's size is odd so many robust standard deviations from its class
_USUAL = 8  # clouds of a class, to know what is usual: of three one is soon far from the others
_FEATURED = 60  # clouds a class that are compared
_SURFACES = 20  # objects a class whose distance to the surface is measured,
_SURFACE_POINTS = 512  # with so many points of each, at random
_SLICES, _SLICED_POINTS = 10, 512
_COLUMNS = ("sub", "tier", "sensor", "vertical")  # of an imported dataset's manifest
_SPACED = (
    *("nn_low", "nn_median", "nn_high", "nn_variation", "voxel_variation", "lonely"),
    *("directions", "below"),
)
_DENSITY = ("nn_median", "nn_variation", "voxel_variation", "directions", "below", "lonely")


def one_cloud(cloud: Float[np.ndarray, "p 3"]) -> dict[str, float]:
    """Size, spacing, density and coverage of a cloud.

    Returns:
        x, y, z, largest: sides of its box, as given; floor, off_centre: its lowest z, and how far
            its centroid is off the origin; radius: its largest distance from the centroid.
        copies: share of points that repeat an earlier one exactly; left out of all below.
        nn_median, nn_low, nn_high: distance to the nearest other point in the unit ball: median,
            5 and 95 %; nn_stored: the median as given.
        nn_variation: its standard deviation over its mean.
        voxel_variation: the same of the points in an occupied voxel.
        lonely: share of points whose 4th neighbour is over five times as far as the median's.
        directions: share of 72 equal bins of direction, from the centroid, with a point in it.
        below: the same for the lowest third of the bins (what a scan from above misses).
    """
    cloud = np.asarray(cloud, dtype=np.float64)
    size, centroid = np.ptp(cloud, axis=0), cloud.mean(axis=0)
    distinct = np.unique(cloud, axis=0)
    found = dict(zip("xyz", map(float, size), strict=True)) | {
        "largest": float(size.max()),
        "floor": float(cloud[:, 2].min()),
        "off_centre": float(np.linalg.norm(centroid)),
        "radius": float(np.linalg.norm(cloud - centroid, axis=1).max()),
        "copies": 1 - len(distinct) / len(cloud),
    }
    if len(distinct) < 5:
        return {**found, **dict.fromkeys(_SPACED, 0.0), "nn_stored": 0.0}
    ball = unit_ball(distinct)
    nearest, fourth = cKDTree(ball).query(ball, k=[2, 5])[0].T
    _, inside = np.unique(np.floor(ball / VOXEL).astype(int), axis=0, return_counts=True)
    values = (
        *np.percentile(nearest, [5, 50, 95]),
        nearest.std() / nearest.mean(),
        inside.std() / inside.mean(),
        (fourth > _OUTLIER * np.median(fourth)).mean(),
        *coverage(ball),
    )
    found |= dict(zip(_SPACED, map(float, values), strict=True))
    return found | {"nn_stored": found["nn_median"] * found["radius"]}


def coverage(ball: Float[np.ndarray, "p 3"]) -> tuple[float, float]:
    """Share of the bins of direction with a point in them: of all, and of the lowest third."""
    norm = np.linalg.norm(ball, axis=1)
    towards = ball[norm > 1e-9] / norm[norm > 1e-9, None]
    azimuth = np.arctan2(towards[:, 1], towards[:, 0]) % (2 * np.pi)
    column = np.minimum((azimuth / (2 * np.pi) * AZIMUTHS).astype(int), AZIMUTHS - 1)
    ring = np.minimum(((towards[:, 2] + 1) / 2 * RINGS).astype(int), RINGS - 1)
    hit = np.zeros((RINGS, AZIMUTHS), dtype=bool)
    hit[ring, column] = True
    return float(hit.mean()), float(hit[: RINGS // 3].mean())


def measured(opened: Opened, sample: int, seed: int = 0) -> pd.DataFrame:
    """A row for each of up to `sample` clouds, drawn with `seed`: id, class, split, `one_cloud`."""
    data, rows = opened.data, []
    some = drawn(np.arange(len(data)), sample, seed)
    with progress_bar(f"inspecting {opened.name}", total=len(some)) as advance:
        for i in some:
            name = "unlabelled" if data.labels[i] < 0 else data.classes[data.labels[i]]
            known = {"id": data.ids[i], "class": name, "split": str(data.splits[i])}
            rows.append(known | one_cloud(data.points[i]))
            advance()
    return pd.DataFrame(rows)


def odd_sizes(clouds: pd.DataFrame) -> list[str]:
    """Ids of clouds far larger or smaller than others of their class, the oddest first."""
    logs = np.log(clouds["largest"].clip(lower=1e-12))
    by_class = logs.groupby(clouds["class"])
    off = (logs - by_class.transform("median")).abs()
    spread = (1.4826 * off.groupby(clouds["class"]).transform("median")).clip(lower=0.02)
    far = (off / spread)[by_class.transform("size") >= _USUAL]
    odd = far[far > _ODD_SIZE].sort_values(ascending=False)
    return list(clouds["id"][odd.index])


def copies(data: PointSet, rows: Sequence[ManifestRow]) -> dict[str, Any]:
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

    def leak(splits: set[str]) -> bool:
        return "test" in splits and len(splits) > 1

    return {
        "clouds": sum(len(found) - 1 for found in same),
        "leaks": sum(leak(set(map(str, data.splits[found]))) for found in same),
        "contradicting_labels": sum(len(set(data.labels[found].tolist())) > 1 for found in same),
        "groups": [[data.ids[i] for i in found] for found in same],
        "meshes": len(meshes),
        "leaking_meshes": sum(map(leak, meshes.values())),
    }


def domain_text(opened: Opened, clouds: pd.DataFrame) -> str:
    """Text about one dataset and its `measured` clouds."""
    data, kept = opened.data, opened.kept
    counts = pd.DataFrame(data.counts()).reindex(data.classes).fillna(0).astype(int)
    counts.loc["unlabelled"] = [(data.labels[data.indices(s)] < 0).sum() for s in counts]
    counts["all"] = counts.sum(axis=1)
    counts = counts[counts["all"] > 0]
    counts.loc["all"] = counts.sum()
    tables = []
    for column in _COLUMNS:
        found = [(row.cls, row.more[column]) for row in kept if row.more.get(column)]
        if found:
            frame = pd.DataFrame(found, columns=["class", column])
            tables.append(frame.value_counts(sort=False).unstack(fill_value=0).to_string())
    points = pd.Series([row.valid_points for row in kept if row.valid_points is not None])
    known = f"{points.median():.0f} (median), at least {points.min()}" if len(points) else ""
    few = int((points < data.points.shape[1]).sum())
    return render(
        "inspection.txt",
        opened=opened,
        counts=counts.to_string(),
        columns=tables,
        points=known + (f"; {few} clouds have too few: some are repeated" if few else ""),
        left_out=Counter(row.status for row in opened.rows if row.status != "ok"),
        unit_ball=((clouds["radius"] - 1).abs() < 1e-3).mean() > 0.99,
        clouds=clouds,
        shapes=_shapes(clouds).to_string(),
        odd=odd_sizes(clouds),
        same=copies(data, opened.rows),
    )


def _shapes(clouds: pd.DataFrame) -> pd.DataFrame:
    """Medians by class and of all, as text; means of what is mostly 0."""
    rows = {}
    for cls, of in [*clouds.groupby("class"), ("all", clouds)]:
        m = of.median(numeric_only=True)
        rows[cls] = {
            **{side: f"{m[side]:.3g}" for side in "xyz"},
            "largest side": f"{of['largest'].min():.3g}..{of['largest'].max():.3g}",
            "spacing": f"{m['nn_low']:.3f} {m['nn_median']:.3f} {m['nn_high']:.3f}",
            "as stored": f"{m['nn_stored']:.3g}",
            "cv": f"{m['nn_variation']:.2f}",
            "cv voxel": f"{m['voxel_variation']:.2f}",
            "seen": f"{m['directions']:.0%}",
            "below": f"{m['below']:.0%}",
            "lonely": f"{of['lonely'].mean():.2%}",
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def compare(a: Opened, b: Opened, seed: int = 0) -> dict[str, Any]:
    """The gap between two datasets.

    Args:
        a, b: the datasets.
        seed: of all draws.

    Raises:
        ConfigError: they have no class in common.
    """
    both = (a, b)
    common = [c for c in a.data.classes if all(len(one.data.members(c)) for one in both)]
    if not common:
        raise ConfigError(f"{a.label} and {b.label} have no class with labels in common")
    count = min(NET_POINTS, *(one.data.points.shape[1] for one in both))
    clouds, labels, values, surfaces = [], [], [], []
    for one in both:
        chosen = _of_each(one, common, _FEATURED, seed)
        labels.append(np.repeat(np.arange(len(common)), [len(of) for of in chosen]))
        clouds.append([_sampled(one.data.points[i], count) for i in np.concatenate(chosen)])
        values.append(pd.DataFrame([one_cloud(cloud) for cloud in clouds[-1]]))
        surfaces.append(surface(one, common, seed))
    shares = [pd.Series({cls: len(one.data.members(cls)) for cls in one.data.classes})
              for one in both]  # fmt: skip
    prior = pd.DataFrame({"A": shares[0], "B": shares[1]}).fillna(0)
    return {
        "a": a.label,
        "b": b.label,
        "made_of_a": str(a.made_of),
        "made_of_b": str(b.made_of),
        "points": count,
        "seed": seed,
        "prior": (prior / prior.sum()).to_dict("index"),
        "cloud": [of.median().to_dict() | of[["copies", "lonely"]].mean().to_dict()
                  for of in values],
        "surface": surfaces,
        "told_apart": _told_apart(clouds, labels, values, len(common)),
    }  # fmt: skip


def surface(opened: Opened, classes: Sequence[str], seed: int = 0) -> dict[str, Any]:
    """How far points lie from the true surface and how much of it was measured.

    The truth is the placed mesh; where that is not known, the clean twin, whose own spacing is
    then part of every distance; where there is none, the truth is unknown. Distances are as
    stored, and in units of the unit ball; the measured share is the mean over the classes.
    """
    surfaces = surfaces_of(opened.data.meta)
    twin = opened.twin if surfaces is None else None
    rng = np.random.default_rng([seed, 1])
    kept = opened.kept
    off, relative, shares = [], [], []
    for chosen in _of_each(opened, classes, _SURFACES, seed):
        seen = []
        for i in chosen:
            cloud = np.asarray(opened.data.points[i], dtype=np.float64)
            mesh = None if surfaces is None else surfaces.mesh(kept[i])
            if mesh is not None:
                some = rng.permutation(len(cloud))[:_SURFACE_POINTS]
                distance = distance_to_mesh(cloud[some], mesh)
                truth = surface_sample(mesh.vertices, mesh.faces, 4096, rng)
            elif twin is not None:
                truth = np.asarray(twin.points[i], dtype=np.float64)
                distance = cKDTree(truth).query(cloud)[0]
            else:
                continue
            radius = float(np.linalg.norm(truth - truth.mean(axis=0), axis=1).max()) or 1.0
            off.append(distance)
            relative.append(distance / radius)
            seen.append((cKDTree(cloud).query(truth)[0] < WITHIN * radius).mean())
        shares += [np.mean(seen)] if seen else []
    if not off:
        return {"truth": "unknown"}
    median, p95 = np.percentile([np.concatenate(off), np.concatenate(relative)], [50, 95], axis=1)
    return {
        "truth": "clean twin" if surfaces is None else "mesh",
        "median": float(median[0]),
        "p95": float(p95[0]),
        "median_ball": float(median[1]),
        "p95_ball": float(p95[1]),
        "measured": float(np.mean(shares)),
    }


def slices(cloud: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " f"]:
    """What describes the shape of a cloud however it is turned about z.

    Of each of ten slices of equal height: the share of points (square root), their mean distance
    from the vertical axis, their spread along and across (standard deviations), how far their
    centre is off the axis; and of the whole the height and the two sides of the base. In units of
    the unit ball; at most 512 points are taken, evenly.
    """
    step = max(1, len(cloud) // _SLICED_POINTS)
    ball = unit_ball(np.asarray(cloud, dtype=np.float64)[::step][:_SLICED_POINTS])
    low, size = ball.min(axis=0), np.ptp(ball, axis=0)
    height = (ball[:, 2] - low[2]) / max(size[2], 1e-9)
    place = np.minimum((height * _SLICES).astype(int), _SLICES - 1)
    count = np.bincount(place, minlength=_SLICES)

    def mean(of: np.ndarray) -> np.ndarray:
        return np.bincount(place, of, minlength=_SLICES) / np.maximum(count, 1)

    u, v = (ball - low - size / 2)[:, :2].T
    mean_u, mean_v = mean(u), mean(v)
    uu, vv = mean(u * u) - mean_u**2, mean(v * v) - mean_v**2
    uv = mean(u * v) - mean_u * mean_v
    middle, spread = (uu + vv) / 2, np.sqrt(((uu - vv) / 2) ** 2 + uv**2)
    parts = (
        np.sqrt(count / len(ball)),
        mean(np.hypot(u, v)),
        np.sqrt(np.maximum(middle + spread, 0)),
        np.sqrt(np.maximum(middle - spread, 0)),
        np.hypot(mean_u, mean_v),
        size[2:],
        np.sort(size[:2]),
    )
    return np.concatenate(parts)


def own_neighbours(a: Float[np.ndarray, "n f"], b: Float[np.ndarray, "n f"]) -> float:
    """Share of clouds whose nearest other cloud, by standardised features, is of its own set.

    0.5: the sets cannot be told apart, 1: two worlds. Leave-one-out 1-NN two-sample test,
    Lopez-Paz and Oquab, "Revisiting Classifier Two-Sample Tests", ICLR 2017.
    """
    both = np.concatenate([a, b])
    both = np.clip((both - both.mean(axis=0)) / (both.std(axis=0) + 1e-9), -5, 5)
    squares = (both**2).sum(axis=1)
    distance = squares[:, None] + squares - 2 * both @ both.T
    np.fill_diagonal(distance, np.inf)
    is_a = np.arange(len(both)) < len(a)
    return float((is_a[distance.argmin(axis=1)] == is_a).mean())


def _told_apart(
    clouds: Sequence[Sequence[np.ndarray]],
    labels: Sequence[np.ndarray],
    values: Sequence[pd.DataFrame],
    classes: int,
) -> dict[str, Any]:
    """`own_neighbours` of equally many clouds of each class from both sides."""
    shapes, density = [], []
    for side in (0, 1):
        rows: list[int] = []
        for k in range(classes):
            equal = min(int((of == k).sum()) for of in labels)
            rows += np.flatnonzero(labels[side] == k)[:equal].tolist()
        few = min(len(clouds[side][i]) for i in rows)
        shapes.append(np.stack([slices(unit_ball(clouds[side][i][:few])) for i in rows]))
        density.append(values[side].loc[rows, list(_DENSITY)].to_numpy())
    every = [np.concatenate(one, axis=1) for one in zip(shapes, density, strict=True)]
    return {
        "clouds": len(every[0]),
        "all": own_neighbours(*every),
        "shape": own_neighbours(*shapes),
        "density": own_neighbours(*density),
    }


def _sampled(cloud: np.ndarray, count: int) -> Float[np.ndarray, "m 3"]:
    """What a net sees: farthest point sampling to `count` points, from the first; unit ball."""
    cloud = unit_ball(np.asarray(cloud, dtype=np.float32))
    return cloud[farthest_point_sampling_np(cloud, count)] if len(cloud) > count else cloud


def _of_each(opened: Opened, classes: Sequence[str], limit: int, seed: int) -> list[np.ndarray]:
    """For each class up to `limit` rows, the same ones for every limit's beginning."""
    found = []
    for cls in classes:
        rng = np.random.default_rng([seed, 2, opened.data.classes.index(cls)])
        found.append(rng.permutation(opened.data.members(cls))[:limit])
    return found


_GLANCE = (
    ("cloud", "nearest-neighbour spacing", "nn_median", "{:.4f}"),
    ("cloud", "its coefficient of variation", "nn_variation", "{:.2f}"),
    ("cloud", "variation of points a voxel (1/8)", "voxel_variation", "{:.2f}"),
    ("cloud", "directions seen", "directions", "{:.0%}"),
    ("cloud", "of the lowest third", "below", "{:.0%}"),
    ("cloud", "repeated points", "copies", "{:.2%}"),
    ("cloud", "lonely points", "lonely", "{:.2%}"),
    ("surface", "off the true surface, median", "median_ball", "{:.4f}"),
    ("surface", "off the true surface, 95 %", "p95_ball", "{:.4f}"),
    ("surface", "off the true surface, median, as stored", "median", "{:.4f}"),
    ("surface", "off the true surface, 95 %, as stored", "p95", "{:.4f}"),
    ("surface", "true surface measured", "measured", "{:.0%}"),
)


def pair_text(facts: Mapping[str, Any]) -> str:
    """Markdown about two datasets (`compare`)."""
    prior = pd.DataFrame.from_dict(facts["prior"], orient="index")
    shown = prior.map("{:.1%}".format)
    shown["B - A"] = (100 * (prior["B"] - prior["A"])).map("{:+.1f}".format)
    rows = {}
    for of, words, key, form in _GLANCE:
        values = [side.get(key) for side in facts[of]]
        if any(value is not None for value in values):
            rows[words] = ["-" if v is None else form.format(v) for v in values]
    glance = pd.DataFrame.from_dict(rows, orient="index", columns=["A", "B"])
    return render(
        "comparison.md",
        **facts,
        prior_table=shown.to_string(),
        total_variation=(prior["A"] - prior["B"]).abs().sum() / 2,
        glance=glance.to_string(),
    )
