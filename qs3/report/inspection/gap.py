"""The gap between two sets of clouds: class frequencies, and how well clouds tell their set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.geometry.sampling import farthest_point_sampling_np, unit_ball
from qs3.report.inspection.gravity import describe
from qs3.store.store import PointSet

Numbers = dict[str, Any]

PLATE_M = 0.08
"""Thinner objects are a front, a back or a top alone."""


def sampled(cloud: np.ndarray, count: int) -> Float[np.ndarray, "m 3"]:
    """What a net sees: farthest point sampling to `count` points, from the first; unit ball."""
    cloud = unit_ball(np.asarray(cloud, dtype=np.float32))
    return cloud[farthest_point_sampling_np(cloud, count)] if len(cloud) > count else cloud


def priors(a: PointSet, b: PointSet) -> Numbers:
    """Class frequencies, and their total variation: half the sum of absolute differences.

    Classes that one of the sets does not have count as frequency 0 there.
    """
    p, q = _shares(a), _shares(b)
    names = dict.fromkeys([*p, *q])
    by_class = {name: [p.get(name, 0.0), q.get(name, 0.0)] for name in names}
    return {
        "by_class": by_class,
        "total_variation": sum(abs(x - y) for x, y in by_class.values()) / 2,
    }


def _shares(data: PointSet) -> dict[str, float]:
    known = max(int(np.sum(data.labels >= 0)), 1)
    return {cls: len(data.members(cls)) / known for cls in data.classes}


def over_the_floor(clouds: Sequence[np.ndarray], floor_m: float) -> Numbers:
    """What of objects in metres is seen: lowest and highest point, the thinnest side, plates.

    Each cloud's points lie between 2 and 98 % of its own, and its thinnest side is their 90 %
    across the plane that fits them best. `low`, `high` [m over the floor] and `thin` [m] are the
    quartiles over the clouds, `plates` is the share thinner than `PLATE_M`.
    """
    rows = []
    for cloud in clouds:
        points = np.asarray(cloud, dtype=np.float64)
        low, high = np.percentile(points[:, 2], [2, 98]) - floor_m
        centred = points - points.mean(axis=0)
        across = centred @ np.linalg.eigh(centred.T @ centred)[1][:, 0]
        rows.append((low, high, float(np.subtract(*np.percentile(across, [95, 5])))))
    values = np.array(rows)
    quartiles = np.percentile(values, [25, 50, 75], axis=0).T.tolist()
    plates = float((values[:, 2] < PLATE_M).mean())
    return {**dict(zip(("low", "high", "thin"), quartiles, strict=True)), "plates": plates}


def features(clouds: Float[np.ndarray, "n p 3"], more: Float[np.ndarray, "n m"]) -> np.ndarray:
    """[n, F] what describes a cloud however it is turned about z: its slices, and `more`."""
    return np.concatenate([describe(clouds)[:, 0], more], axis=1)


def nearest_neighbour(a: Float[np.ndarray, "n f"], b: Float[np.ndarray, "n f"]) -> float:
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
