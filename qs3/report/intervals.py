r"""Shares of right predictions, and differences of them, with their intervals at 95 %.

Predictions vary with the seed of a run, and with what test clouds share: scans of one mesh, the
objects of a room or of a block of frames are not independent. A mean p = Σ_{s,i} w_i v_{s,i} / S
over seeds s and clouds i (w_i is 1/n, or 1/(C n_class) for balanced accuracy of C classes) has
errors that are clustered by both. They are crossed, e_sc = a_s + b_c + r_sc, so the sums of each
way hold the rest, r, too. It is taken off the clusters, as Cameron, Gelbach, Miller, "Robust
Inference with Multiway Clustering", J. Business & Economic Statistics 2011, eq. 2.11 take off the
cells' variance; but theirs holds b as well, and with few seeds that is much of it. So r is what is
left of the cells without the means of both ways (two-way analysis of variance). Few clusters say
little about their variance, so each way has its own quantile of Student's t:
half width² = t²(S - 1) V_seeds + t²(M - 1) V_clusters.

For a balanced share that would count how many objects of easy classes a cluster happens to have.
Its errors are about the recall of the class, over √(1 - h): h is the share of the class's objects
that lie in this cluster, by which they pull the recall towards themselves (CR2: Bell and McCaffrey,
"Bias Reduction in Standard Errors for Linear Regression with Multi-Stage Samples", Survey
Methodology 2002, for a mean). A class seen in one cluster alone adds nothing to that variance, and
the interval is then too narrow.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import t as student_t

LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """A share in [0, 1], or a difference of two in [-1, 1].

    `mean` is over seeds, `sem` its standard error (None for one). `low` and `high` are the ends at
    `LEVEL`, over clusters alone for one seed; None with a single cluster.
    """

    mean: float
    sem: float | None
    low: float | None
    high: float | None
    seeds: int
    clusters: int

    @property
    def clear(self) -> bool:
        """Whether 0 lies outside the interval."""
        return self.low is not None and self.high is not None and (self.low > 0 or self.high < 0)

    def percent(self, sign: str = "") -> str:
        """Such as "64.0 [58.1, 69.9]"; with `sign` "+" for differences."""
        ends = ""
        if self.low is not None and self.high is not None:
            ends = f" [{100 * self.low:{sign}.1f}, {100 * self.high:{sign}.1f}]"
        return f"{100 * self.mean:{sign}.1f}{ends}"


def share(
    right: Bool[np.ndarray, "s n"],
    labels: Int[np.ndarray, " n"],
    clusters: Int[np.ndarray, " n"],
    *,
    balanced: bool = False,
) -> Interval:
    """Accuracy, or balanced accuracy over the classes that are there.

    Args:
        right: whether the run of each seed is right about each cloud.
        labels: true classes.
        clusters: of each cloud, any numbers.
        balanced: mean of the recalls.
    """
    values, weight = right.astype(float), _weights(labels, balanced)
    errors = _about_recalls(values, labels, clusters) if balanced else values - values.mean()
    return _interval(values, errors, weight, clusters, 0.0)


def difference(
    values: Float[np.ndarray, "s n"],
    labels: Int[np.ndarray, " n"],
    clusters: Int[np.ndarray, " n"],
    *,
    balanced: bool = False,
) -> Interval:
    """Mean of paired differences of being right, in [-1, 1], of each seed and cloud."""
    weight = _weights(labels, balanced)
    return _interval(values, values - (values @ weight).mean(), weight, clusters, -1.0)


def _weights(labels: Int[np.ndarray, " n"], balanced: bool) -> Float[np.ndarray, " n"]:
    if not balanced:
        return np.full(len(labels), 1 / len(labels))
    classes, index, counts = np.unique(labels, return_inverse=True, return_counts=True)
    return 1 / (len(classes) * counts[index])


def _about_recalls(
    values: Float[np.ndarray, "s n"], labels: Int[np.ndarray, " n"], clusters: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "s n"]:
    """Errors about each class's recall, larger by what a cluster pulls it towards itself."""
    _, kind, counts = np.unique(labels, return_inverse=True, return_counts=True)
    recalls = np.bincount(kind, values.mean(axis=0)) / counts
    _, both, together = np.unique(
        np.stack([labels, clusters]), axis=1, return_inverse=True, return_counts=True
    )
    left = 1 - together[both] / counts[kind]  # 0: all of the class is here, and its errors cancel
    return (values - recalls[kind]) / np.sqrt(np.where(left > 0, left, 1))


def _interval(
    values: Float[np.ndarray, "s n"],
    errors: Float[np.ndarray, "s n"],
    weight: Float[np.ndarray, " n"],
    clusters: Int[np.ndarray, " n"],
    least: float,
) -> Interval:
    """The weighted mean of `values`, with an interval within [least, 1]."""
    seeds, each = len(values), values @ weight
    mean = float(each.mean())
    sem = float(each.std(ddof=1) / math.sqrt(seeds)) if seeds > 1 else None
    _, cluster = np.unique(clusters, return_inverse=True)
    m = int(cluster.max()) + 1
    if m < 2:
        return Interval(mean, sem, None, None, seeds, m)
    of_seeds, of_clusters = _variances(errors, weight, cluster)
    half = math.sqrt(_t2(m) * of_clusters + (_t2(seeds) * of_seeds if seeds > 1 else 0.0))
    return Interval(mean, sem, max(least, mean - half), min(1.0, mean + half), seeds, m)


def _variances(
    errors: Float[np.ndarray, "s n"],
    weight: Float[np.ndarray, " n"],
    cluster: Int[np.ndarray, " n"],
) -> tuple[float, float]:
    """V_seeds (0 of one seed), and V_clusters less what neither way explains, at least 0."""
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


def _variance(sums: Float[np.ndarray, " c"]) -> float:
    """Variance of a sum of independent clusters of mean 0, with the small-sample factor."""
    return float((sums**2).sum()) * len(sums) / (len(sums) - 1)


def _t2(clusters: int) -> float:
    """Square of Student's quantile at `LEVEL` for the mean of so many clusters, two or more."""
    return float(student_t.ppf(0.5 + LEVEL / 2, clusters - 1) ** 2)
