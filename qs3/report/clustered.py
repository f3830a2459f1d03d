"""Variance of a mean of errors that are clustered two ways, and Student's quantiles for it.

The two ways are seeds, and what objects share: the scans of a mesh, or the frames of a room. They
are crossed, e_sc = a_s + b_c + r_sc, so each way's own clusters hold what is left, r, as well. It
is taken off one of them, as Cameron, Gelbach, Miller, "Robust Inference with Multiway Clustering",
J. Business & Economic Statistics 2011, eq. 2.11 take off the cells' variance; but theirs holds b,
too, and with few seeds that is much of it: with two seeds that agree in all, half. So r is what is
left of the cells without the means of both ways (two-way analysis of variance). Few clusters say
little about their variance, so each way has its own quantile:
half width² = t²(S - 1) V_seeds + t²(M - 1) V_clusters.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import t as student_t

LEVEL = 0.95


def weights(labels: Int[np.ndarray, " n"], balanced: bool) -> Float[np.ndarray, " n"]:
    """Weights of objects in a mean: 1/n, or 1/(C n_class) for balanced accuracy of C classes."""
    if not balanced:
        return np.full(len(labels), 1 / len(labels))
    classes, index, counts = np.unique(labels, return_inverse=True, return_counts=True)
    return 1 / (len(classes) * counts[index])


def variances(
    errors: Float[np.ndarray, "s n"],
    weight: Float[np.ndarray, " n"],
    cluster: Int[np.ndarray, " n"],
) -> tuple[float, float]:
    """V_seeds, and V_clusters less what no way has of its own, or 0 if that is more.

    Args:
        errors: of each seed and object, of mean 0; the mean whose variance it is has `weight` over
            objects and 1/S over seeds. Of one seed V_seeds is 0, and V_clusters is whole.
        weight: of each object, of sum 1.
        cluster: of each object, 0 ... M - 1, M >= 2.
    """
    seeds, clusters = len(errors), int(cluster.max()) + 1
    cells = np.zeros((seeds, clusters))
    np.add.at(cells.T, cluster, (errors * weight).T)
    cells /= seeds
    of_clusters = _variance(cells.sum(axis=0))
    if seeds == 1:
        return 0.0, of_clusters
    of_seed = cells.sum(axis=1)
    of_seed -= of_seed.mean()
    rest = cells - cells.mean(axis=0) - of_seed[:, None] * np.bincount(cluster, weight, clusters)
    left = float((rest**2).sum()) * seeds / (seeds - 1) * clusters / (clusters - 1)
    return _variance(of_seed), max(0.0, of_clusters - left)


def t2(clusters: Any) -> Any:
    """Square of Student's quantile at `LEVEL` for the mean of so many clusters, two or more."""
    return student_t.ppf(0.5 + LEVEL / 2, clusters - 1) ** 2


def _variance(sums: Float[np.ndarray, " c"]) -> float:
    """Variance of a sum of independent clusters of mean 0, with the small-sample factor."""
    return float((sums**2).sum()) * len(sums) / (len(sums) - 1)
