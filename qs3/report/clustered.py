"""Variance of a mean of errors that are clustered two ways, and Student's quantiles for it.

Cameron, Gelbach, Miller, "Robust Inference with Multiway Clustering", J. Business & Economic
Statistics 2011, eq. 2.11. The two ways are seeds, and what objects share: the scans of a mesh, or
the frames of a room. Few clusters say little about their variance, so each way has its own
quantile: half width² = t²(S - 1) V_seeds + t²(M - 1) V_clusters.
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
    errors: Float[np.ndarray, "s n"], cluster: Int[np.ndarray, " n"]
) -> tuple[float, float]:
    """V_seeds, and V_clusters less what is in both, or 0 if that is more.

    Args:
        errors: what each seed and object adds to the sum over objects, of mean 0; the mean is over
            seeds. Of one seed V_seeds is 0, and V_clusters is whole.
        cluster: of each object, 0 ... M - 1, M >= 2.
    """
    seeds = len(errors)
    cells = np.zeros((seeds, int(cluster.max()) + 1))
    np.add.at(cells.T, cluster, errors.T)
    cells /= seeds
    of_clusters = _variance(cells.sum(axis=0))
    if seeds == 1:
        return 0.0, of_clusters
    both = float((cells**2).sum())
    return _variance(cells.sum(axis=1)), max(0.0, of_clusters - both)


def t2(clusters: Any) -> Any:
    """Square of Student's quantile at `LEVEL` for the mean of so many clusters, two or more."""
    return student_t.ppf(0.5 + LEVEL / 2, clusters - 1) ** 2


def _variance(sums: Float[np.ndarray, " c"]) -> float:
    """Variance of a sum of independent clusters of mean 0, with the small-sample factor."""
    return float((sums**2).sum()) * len(sums) / (len(sums) - 1)
