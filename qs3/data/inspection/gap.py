"""The gap between two sets of clouds, as distances: Chamfer by class, and of the distributions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from qs3.data.inspection.gravity import describe, turned
from qs3.data.inspection.measures import prior
from qs3.data.store import PointSet
from qs3.geometry.sampling import farthest_point_sampling_np, unit_ball

_COARSE, _FINE = 128, 512  # points of a cloud to find the yaw with, and to measure with
_YAWS = 12

Numbers = dict[str, Any]


def sampled(cloud: np.ndarray, count: int) -> Float[np.ndarray, "m 3"]:
    """What a net sees: farthest point sampling to `count` points, from the first; unit ball."""
    cloud = unit_ball(np.asarray(cloud, dtype=np.float32))
    return cloud[farthest_point_sampling_np(cloud, count)] if len(cloud) > count else cloud


def chamfer(
    a: Float[np.ndarray, "p 3"], b: Float[np.ndarray, "q 3"]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " q"]]:
    """Distance of each point to the nearest of the other cloud, both ways."""
    return cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]


def best_yaw_rad(a: Float[np.ndarray, "p 3"], b: Float[np.ndarray, "q 3"]) -> float:
    """Which of twelve yaws turns `a` to lie best on `b`; both clouds in FPS order."""
    a, b = a[:_COARSE], b[:_COARSE]
    tree_a, tree_b = cKDTree(a), cKDTree(b)
    yaws = np.arange(_YAWS) * 2 * np.pi / _YAWS
    there = tree_b.query(np.concatenate([turned(a, yaw) for yaw in yaws]))[0].reshape(_YAWS, -1)
    back = tree_a.query(np.concatenate([turned(b, -yaw) for yaw in yaws]))[0].reshape(_YAWS, -1)
    return float(yaws[(there.mean(axis=1) + back.mean(axis=1)).argmin()])


def chamfer_by_class(
    a: Mapping[str, list[np.ndarray]],
    b: Mapping[str, list[np.ndarray]],
    within: float,
) -> Numbers:
    """Distances between objects of one class: within A, within B, from A to B.

    Args:
        a, b: by class, clouds in the unit ball in FPS order.
        within: a point counts as found in the other cloud up to this distance.

    Returns:
        By class the means over pairs of clouds of the Chamfer distance (mean of both directions,
        not squared, in units of the unit ball, best of twelve yaws), and what share of the
        points of B's clouds A's nearest cloud has (and the other way round).
    """
    found: Numbers = {}
    for cls in a:
        if cls in b and len(a[cls]) and len(b[cls]):
            fine_a, fine_b = ([cloud[:_FINE] for cloud in of[cls]] for of in (a, b))
            inside_a = [_pair(x, y)[0] for i, x in enumerate(fine_a) for y in fine_a[:i]]
            inside_b = [_pair(x, y)[0] for i, x in enumerate(fine_b) for y in fine_b[:i]]
            across = [[_pair(x, y, within) for y in fine_b] for x in fine_a]
            distance = np.array([[p[0] for p in row] for row in across])
            nearest = distance.argmin(axis=0)  # of A, for each of B
            found[cls] = {
                "clouds": [len(fine_a), len(fine_b)],
                "within_a": float(np.mean(inside_a)) if inside_a else None,
                "within_b": float(np.mean(inside_b)) if inside_b else None,
                "a_to_b": float(distance.mean()),
                "a_found_in_b": float(np.mean([across[i][j][1] for j, i in enumerate(nearest)])),
                "b_found_in_a": float(np.mean([across[i][j][2] for j, i in enumerate(nearest)])),
            }
    return found


def _pair(a: np.ndarray, b: np.ndarray, within: float = 0.1) -> tuple[float, float, float]:
    there, back = chamfer(turned(a, best_yaw_rad(a, b)), b)
    shares = (float((there < within).mean()), float((back < within).mean()))
    return (float(there.mean() + back.mean()) / 2, *shares)


def priors(a: PointSet, b: PointSet) -> Numbers:
    """Class frequencies, and their total variation: half the sum of absolute differences.

    Classes that one of the sets does not have count as frequency 0 there.
    """
    p, q = (dict(zip(data.classes, prior(data).tolist(), strict=True)) for data in (a, b))
    names = [*p, *(name for name in q if name not in p)]
    by_class = {name: [p.get(name, 0.0), q.get(name, 0.0)] for name in names}
    return {
        "by_class": by_class,
        "total_variation": sum(abs(x - y) for x, y in by_class.values()) / 2,
    }


def features(clouds: Float[np.ndarray, "n p 3"], more: Float[np.ndarray, "n m"]) -> np.ndarray:
    """[n, F] what describes a cloud however it is turned about z: its slices, and `more`."""
    return np.concatenate([describe(clouds)[:, 0], more], axis=1)


def two_samples(
    a: Float[np.ndarray, "n f"], b: Float[np.ndarray, "n f"], seed: int, permutations: int = 200
) -> Numbers:
    """How far two samples of equally many clouds are from being of one distribution.

    Returns:
        nearest_neighbour: share of clouds whose nearest other cloud is of its own set, Lopez-Paz
            and Oquab 2017: 0.5 cannot be told apart, 1 are two worlds.
        mmd: maximum mean discrepancy, Gretton et al. 2012: unbiased MMD^2, Gaussian kernel of
            the median distance.
        mmd_chance: its 95 % quantile where the sets are mixed at random.
    """
    n = len(a)
    both = np.concatenate([a, b])
    both = np.clip((both - both.mean(axis=0)) / (both.std(axis=0) + 1e-9), -5, 5)
    squares = (both**2).sum(axis=1)
    distance = np.maximum(squares[:, None] + squares - 2 * both @ both.T, 0)
    is_a = np.arange(2 * n) < n
    scale = np.median(distance[np.triu_indices(2 * n, 1)])
    kernel = np.exp(-distance / max(scale, 1e-12))
    np.fill_diagonal(distance, np.inf)
    np.fill_diagonal(kernel, 0)
    rng = np.random.default_rng(seed)
    chance = [_mmd(kernel, rng.permutation(is_a)) for _ in range(permutations)]
    return {
        "clouds": n,
        "nearest_neighbour": float((is_a[distance.argmin(axis=1)] == is_a).mean()),
        "mmd": _mmd(kernel, is_a),
        "mmd_chance": float(np.percentile(chance, 95)),
    }


def _mmd(kernel: Float[np.ndarray, "n n"], is_a: Bool[np.ndarray, " n"]) -> float:
    x = is_a.astype(np.float64)
    y = 1 - x
    m, n = x.sum(), y.sum()
    inside = x @ kernel @ x / (m * (m - 1)) + y @ kernel @ y / (n * (n - 1))
    return float(inside - 2 * (x @ kernel @ y) / (m * n))
