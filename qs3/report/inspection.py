"""What datasets are like: counts, sizes, spacing, coverage, copies, pictures, the gap of two."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.spatial import cKDTree

from qs3.errors import ConfigError
from qs3.geometry.sampling import farthest_point_sampling_np, unit_ball
from qs3.report.datasets import Opened
from qs3.report.viewer import drawn
from qs3.store.meta import ManifestRow
from qs3.store.store import PointSet, open_pointset
from qs3.utils.page import render
from qs3.utils.pictures import AZIMUTH_DEG, Image, cloud_image, sheet, turn_deg
from qs3.utils.progress import progress_bar

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NET_POINTS = 1024
"""Two datasets are compared with so many points a cloud, by farthest point sampling."""

WITHIN = 0.1
"""A point of the surface counts as measured with a point so near, in units of the unit ball."""

AZIMUTHS, RINGS = 12, 6
"""Directions are counted in 12 x 6 bins of equal solid angle."""

_COMPARED = 60  # clouds a class
_SIDE_PX, _POINTS = 376, 1024  # of a picture on a sheet
_SPACED = ("nn_median", "nn_variation", "directions", "below")


def one_cloud(cloud: Float[np.ndarray, "p 3"]) -> dict[str, float]:
    """Size, spacing, density and coverage of a cloud.

    Returns:
        x, y, z, largest: sides of its box, as given; floor, off_centre: its lowest z, and how far
            its centroid is off the origin; radius: its largest distance from the centroid.
        copies: share of points that repeat an earlier one exactly; left out of all below.
        nn_median: median distance to the nearest other point, in the unit ball.
        nn_variation: the distances' standard deviation over their mean.
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
    if len(distinct) < 2:
        return {**found, **dict.fromkeys(_SPACED, 0.0)}
    ball = unit_ball(distinct)
    nearest = cKDTree(ball).query(ball, 2)[0][:, 1]
    spaced = (np.median(nearest), nearest.std() / nearest.mean(), *coverage(ball))
    return found | dict(zip(_SPACED, map(float, spaced), strict=True))


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


def measured(opened: Opened, sample: int) -> pd.DataFrame:
    """A row for each of up to `sample` clouds, drawn at random: id, class, split, `one_cloud`."""
    data, rows = opened.data, []
    some = drawn(np.arange(len(data)), sample)
    with progress_bar(f"inspecting {opened.name}", total=len(some)) as advance:
        for i in some:
            name = "unlabelled" if data.labels[i] < 0 else data.classes[data.labels[i]]
            known = {"id": data.ids[i], "class": name, "split": str(data.splits[i])}
            rows.append(known | one_cloud(data.points[i]))
            advance()
    return pd.DataFrame(rows)


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
    data = opened.data
    counts = pd.DataFrame(data.counts()).reindex(data.classes).fillna(0).astype(int)
    counts.loc["unlabelled"] = [(data.labels[data.indices(s)] < 0).sum() for s in counts]
    counts["all"] = counts.sum(axis=1)
    counts = counts[counts["all"] > 0]
    counts.loc["all"] = counts.sum()
    points = pd.Series([row.valid_points for row in opened.kept if row.valid_points is not None])
    known = f"{points.median():.0f} (median), at least {points.min()}" if len(points) else ""
    few = int((points < data.points.shape[1]).sum())
    return render(
        "inspection.txt",
        opened=opened,
        counts=counts.to_string(),
        points=known + (f"; {few} clouds have too few: some are repeated" if few else ""),
        left_out=Counter(row.status for row in opened.rows if row.status != "ok"),
        unit_ball=((clouds["radius"] - 1).abs() < 1e-3).mean() > 0.99,
        clouds=clouds,
        shapes=_shapes(clouds).to_string(),
        same=copies(data, opened.rows),
    )


def _shapes(clouds: pd.DataFrame) -> pd.DataFrame:
    """Medians by class and of all, as text."""
    rows = {}
    for cls, of in [*clouds.groupby("class"), ("all", clouds)]:
        m = of.median(numeric_only=True)
        rows[cls] = {
            **{side: f"{m[side]:.3g}" for side in "xyz"},
            "largest side": f"{of['largest'].min():.3g}..{of['largest'].max():.3g}",
            "spacing": f"{m['nn_median']:.3f}",
            "cv": f"{m['nn_variation']:.2f}",
            "seen": f"{m['directions']:.0%}",
            "below": f"{m['below']:.0%}",
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def compare(a: Opened, b: Opened) -> dict[str, Any]:
    """The gap between two datasets, by up to 60 clouds a class, drawn at random."""
    both = (a, b)
    common = [c for c in a.data.classes if all(len(one.data.members(c)) for one in both)]
    if not common:
        raise ConfigError(f"{a.label} and {b.label} have no class with labels in common")
    count = min(NET_POINTS, *(one.data.points.shape[1] for one in both))
    shares = [
        pd.Series({cls: len(one.data.members(cls)) for cls in one.data.classes}) for one in both
    ]
    prior = pd.DataFrame(dict(zip("AB", shares, strict=True))).fillna(0)
    clouds = []
    for one in both:
        positions: list[int] = []
        for cls in common:
            rng = np.random.default_rng([0, 2, one.data.classes.index(cls)])
            positions += rng.permutation(one.data.members(cls))[:_COMPARED].tolist()
        seen = []
        for i in positions:  # as a net sees them
            ball = unit_ball(np.asarray(one.data.points[i], dtype=np.float32))
            few = farthest_point_sampling_np(ball, count) if len(ball) > count else slice(None)
            seen.append(one_cloud(ball[few]))
        table = pd.DataFrame(seen)
        repeated = {"copies": float(table["copies"].mean())}  # mostly 0, as its median is
        clouds.append(table.median().to_dict() | repeated | surface(one, positions))
    return {
        "a": a.label,
        "b": b.label,
        "made_of_a": str(a.made_of),
        "made_of_b": str(b.made_of),
        "points": count,
        "prior": (prior / prior.sum()).to_dict("index"),
        "cloud": clouds,
    }


def surface(opened: Opened, positions: Sequence[int]) -> dict[str, float]:
    """How far points lie from the clean twin's, and the share of the twin's that has one near.

    In units of the unit ball; the twin's own spacing is part of every distance. {} without twins.
    """
    if opened.variant == "points_clean" or "points_clean" not in opened.data.meta["sha256"]:
        return {}
    twin = open_pointset(opened.folder, "points_clean", verify=False)
    off, seen = [], []
    for i in positions:
        cloud = np.asarray(opened.data.points[i], dtype=np.float64)
        truth = np.asarray(twin.points[i], dtype=np.float64)
        radius = float(np.linalg.norm(truth - truth.mean(axis=0), axis=1).max()) or 1.0
        off.append(cKDTree(truth).query(cloud)[0] / radius)
        seen.append((cKDTree(cloud).query(truth)[0] < WITHIN * radius).mean())
    median, p95 = np.percentile(np.concatenate(off), [50, 95])
    return {"off": float(median), "off_95": float(p95), "measured": float(np.mean(seen))}


_GLANCE = {
    "nn_median": ("nearest-neighbour spacing", "{:.4f}"),
    "nn_variation": ("its coefficient of variation", "{:.2f}"),
    "directions": ("directions seen", "{:.0%}"),
    "below": ("of the lowest third", "{:.0%}"),
    "copies": ("repeated points", "{:.2%}"),
    "off": ("off the clean twin, median", "{:.4f}"),
    "off_95": ("off the clean twin, 95 %", "{:.4f}"),
    "measured": ("clean twin measured", "{:.0%}"),
}


def pair_text(facts: Mapping[str, Any]) -> str:
    """Markdown about two datasets (`compare`)."""
    prior = pd.DataFrame.from_dict(facts["prior"], orient="index")
    shown = prior.map("{:.1%}".format)
    shown["B - A"] = (100 * (prior["B"] - prior["A"])).map("{:+.1f}".format)
    rows = {
        words: [form.format(side[key]) if key in side else "-" for side in facts["cloud"]]
        for key, (words, form) in _GLANCE.items()
        if any(key in side for side in facts["cloud"])
    }
    glance = pd.DataFrame.from_dict(rows, orient="index", columns=["A", "B"])
    return render(
        "comparison.md",
        **facts,
        prior_table=shown.to_string(),
        total_variation=(prior["A"] - prior["B"]).abs().sum() / 2,
        glance=glance.to_string(),
    )


def contact_sheet(
    clouds: Sequence[np.ndarray | None], titles: Sequence[str], columns: int = 6, **words: Any
) -> Figure:
    """A sheet of clouds [P, 3], z up; `words` as of `qs3.utils.pictures.sheet`.

    What lies off the origin is seen from there, a little from the side: that is where a single
    view has its camera.
    """
    images: list[Image | None] = []
    for cloud in clouds:
        if cloud is None:
            images.append(None)
            continue
        cloud = np.asarray(cloud, dtype=np.float64)
        some = cloud[:: max(1, len(cloud) // _POINTS)]
        images.append(cloud_image(some, _SIDE_PX, AZIMUTH_DEG + turn_deg(cloud)))
    return sheet(images, titles, columns=columns, **words)


def scan_picture(domains: Mapping[str, PointSet], split: str) -> Figure:
    """One object of each class as each domain (by its title) has it, two classes a row.

    Where all domains have an id (a cloud and its clean twin, surface samples of the same mesh) the
    object is the same; else it is the domain's first of that class.
    """
    sets = [data.split(split) for data in domains.values()]
    classes = sets[0].classes
    half = -(-len(classes) // 2)
    clouds, titles = [], []
    for cls in (cls for i in range(half) for cls in classes[i::half]):
        places = [{data.ids[i]: i for i in data.members(cls)} for data in sets]
        shared = next((name for name in places[0] if all(name in of for of in places)), None)
        for data, of in zip(sets, places, strict=True):
            name = shared or next(iter(of), None)
            clouds.append(None if name is None else data.points[of[name]])
            titles.append(cls if of else f"no {cls}")
    return contact_sheet(clouds, titles, 2 * len(sets), heads=[*domains] * 2)
