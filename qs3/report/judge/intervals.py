r"""A share of right predictions with its interval: over seeds, and over blocks of frames.

Objects of one room are not independent: same furniture, same light, same distance. The share
p = Σ_{s,i} w_i a_{s,i} / S (a is 1 if the run of seed s is right about object i; w_i is 1/n, or
1/(C n_class) for balanced accuracy, C the classes that are there) therefore gets the variance of
errors clustered by block and by seed (`qs3.report.clustered`). What an object adds is its error
about the mean. So it is for differences, too, whose intervals are those of
`qs3.report.tables.paired`.

For a balanced share that would count how many objects of easy classes a block happens to have. Its
errors are about the recall of the class, over √(1 - h): h is the share of the class's objects that
lie in this block, by which they pull the recall towards themselves (CR2: Bell and McCaffrey, "Bias
Reduction in Standard Errors for Linear Regression with Multi-Stage Samples", Survey Methodology
2002, for a mean). How often these intervals hold the truth: tests/report/balanced_coverage.py.

Of one seed the interval is over blocks alone. It is no wider than [0, 1]. A class that was seen
in one block alone adds nothing to the variance of a balanced share, although nobody knows how it
varies from room to room: with such classes that interval is too narrow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.report.clustered import t2, variances, weights


@dataclass(frozen=True)
class Share:
    """A share of right predictions, in [0, 1], or a difference of two, in [-1, 1].

    Attributes:
        mean: over seeds.
        sem: standard error over seeds; None for one.
        low, high: its interval at `clustered.LEVEL`; None with a single block.
    """

    mean: float
    sem: float | None
    low: float | None
    high: float | None


def share(
    right: Bool[np.ndarray, "s n"],
    labels: Int[np.ndarray, " n"],
    blocks: Int[np.ndarray, " n"],
    *,
    balanced: bool = False,
) -> Share:
    """Accuracy, or balanced accuracy over the classes that are there.

    Args:
        right: whether the run of each seed is right about each object.
        labels: true classes.
        blocks: cluster of each object, any numbers.
        balanced: mean of the recalls.
    """
    values, weight = right.astype(float), weights(labels, balanced)
    errors = _about_recalls(values, labels, blocks) if balanced else values - values.mean()
    return _over(values, errors, weight, blocks, (0.0, 1.0))


def difference(
    a: Bool[np.ndarray, "s n"],
    b: Bool[np.ndarray, "t n"],
    labels: Int[np.ndarray, " n"],
    blocks: Int[np.ndarray, " n"],
    *,
    balanced: bool = False,
    same_seeds: bool = True,
) -> Share:
    """Share of a less that of b, paired: object by object, and seed by seed.

    If they have other seeds, or not as many, these are averaged first, and the interval is over
    blocks alone: it then tells nothing of other seeds.

    Args:
        a, b: as in `share`.
        labels, blocks, balanced: as in `share`.
        same_seeds: whether row k of both is of the same seed.
    """
    x, y = a.astype(float), b.astype(float)
    if len(x) != len(y) or not same_seeds:
        x, y = x.mean(axis=0, keepdims=True), y.mean(axis=0, keepdims=True)
    values, weight = x - y, weights(labels, balanced)
    return _over(values, values - (values @ weight).mean(), weight, blocks, (-1.0, 1.0))


def _about_recalls(
    values: Float[np.ndarray, "s n"], labels: Int[np.ndarray, " n"], blocks: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "s n"]:
    """Errors about the recall of each class, larger by what each block pulls it towards itself."""
    _, kind, counts = np.unique(labels, return_inverse=True, return_counts=True)
    recalls = np.bincount(kind, values.mean(axis=0)) / counts
    _, both, together = np.unique(
        np.stack([labels, blocks]), axis=1, return_inverse=True, return_counts=True
    )
    left = 1 - together[both] / counts[kind]  # 0: all of the class is here, and its errors cancel
    return (values - recalls[kind]) / np.sqrt(np.where(left > 0, left, 1))


def _over(
    values: Float[np.ndarray, "s n"],
    errors: Float[np.ndarray, "s n"],
    weight: Float[np.ndarray, " n"],
    blocks: Int[np.ndarray, " n"],
    ends: tuple[float, float],
) -> Share:
    """The weighted mean of each seed's and object's value, with its interval within `ends`."""
    seeds, each = len(values), values @ weight
    mean = float(each.mean())
    sem = float(each.std(ddof=1) / math.sqrt(seeds)) if seeds > 1 else None
    _, block = np.unique(blocks, return_inverse=True)
    m = int(block.max()) + 1
    if m < 2:
        return Share(mean, sem, None, None)
    of_seeds, of_blocks = variances(errors, weight, block)
    half2 = t2(m) * of_blocks + (t2(seeds) * of_seeds if seeds > 1 else 0.0)
    half = math.sqrt(half2)
    return Share(mean, sem, max(ends[0], mean - half), min(ends[1], mean + half))
