r"""Are two rows of a table different? Paired over test clouds and seeds, with clouds in clusters.

Both rows are judged on the same clouds with the same seeds, so their difference is a mean over
pairs: d = Σ_{s,i} w_i (a_{s,i} - b_{s,i}) / S, where a and b are 1 if the row's run of seed s is
right about cloud i, and w_i is 1/n for accuracy, 1/(C n_class) for balanced accuracy.

Two things make d vary: other seeds, and other test meshes (scans of one mesh are not independent
samples, nor are the objects of a room or of a block of frames). Their variances are those of errors
clustered two ways (`qs3.report.clustered`). With three seeds intervals are wide, as they should be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from qs3.errors import DataError
from qs3.report.clustered import t2, variances, weights
from qs3.runs.predictions import Predictions

_SEEDS = np.arange(2, 1001)
_T2_OF_SEEDS = t2(_SEEDS)


@dataclass(frozen=True)
class Difference:
    """Row A minus row B.

    Attributes:
        mean: in [-1, 1].
        low, high: its interval at `clustered.LEVEL`.
        seeds, meshes: numbers of each; `meshes` are what clouds of one cluster share, see
            `qs3.runs.predictions`.
        seeds_needed: so many would make 0 fall outside the interval, if the difference stays as it
            is; None if no number of seeds would, because there are too few clusters.
    """

    mean: float
    low: float
    high: float
    seeds: int
    meshes: int
    seeds_needed: int | None

    @property
    def clear(self) -> bool:
        """Whether 0 lies outside the interval."""
        return self.low > 0 or self.high < 0


def compare(
    a: Sequence[Predictions], b: Sequence[Predictions], *, balanced: bool = False
) -> Difference:
    """The difference in accuracy (or balanced accuracy) between the predictions of two rows.

    Raises:
        DataError: the clouds differ, have no labels, or there are fewer than two seeds or meshes.
    """
    return compare_on_average([(a, b)], balanced=balanced)


def compare_on_average(
    pairs: Sequence[tuple[Sequence[Predictions], Sequence[Predictions]]],
    *,
    balanced: bool = False,
) -> Difference:
    """The mean of several differences, such as those of two columns of a table over its rows.

    The rows themselves are taken as given: the interval is over seeds and meshes, as for one.

    Args:
        pairs: rows A and B; of each the predictions by seed, the same seeds in the same order.
        balanced: compare balanced accuracy instead.

    Raises:
        DataError: as `compare`.
    """
    first = next((one for pair in pairs for one in pair[0]), None)
    counts = {len(row) for pair in pairs for row in pair}
    if first is None or len(counts) > 1 or min(counts) < 2:
        got = " and ".join(map(str, sorted(counts)))
        raise DataError(f"a comparison needs two seeds that both have, got {got}")
    for one in (one for pair in pairs for row in pair for one in row):
        if one.ids != first.ids or not np.array_equal(one.labels, first.labels):
            raise DataError("the runs were evaluated on different clouds; they cannot be paired")
    if (first.labels < 0).any():
        raise DataError("the clouds have no labels")
    differences = np.mean([_right(a) - _right(b) for a, b in pairs], axis=0)
    _, mesh = np.unique(first.meshes, return_inverse=True)
    return interval(differences, weights(first.labels, balanced), mesh)


def _right(row: Sequence[Predictions]) -> Float[np.ndarray, "s n"]:
    return np.stack([one.predicted == one.labels for one in row]).astype(float)


def interval(
    differences: Float[np.ndarray, "s n"],
    weight: Float[np.ndarray, " n"],
    mesh: Int[np.ndarray, " n"],
) -> Difference:
    """Mean and interval of weighted differences; see the module's text.

    Args:
        differences: of each seed and cloud, in [-1, 1].
        weight: that sum to 1.
        mesh: cluster of each cloud, 0 ... M - 1.
    """
    seeds, meshes = len(differences), int(mesh.max()) + 1
    if meshes < 2:
        raise DataError("a comparison needs test clouds of at least two meshes")
    mean = float((differences @ weight).mean())
    of_seeds, of_meshes = variances(differences - mean, weight, mesh)
    half = math.sqrt(t2(seeds) * of_seeds + t2(meshes) * of_meshes)
    # with other numbers of seeds, each of which varies as these do
    halves = np.sqrt(_T2_OF_SEEDS * of_seeds * seeds / _SEEDS + t2(meshes) * of_meshes)
    enough = _SEEDS[halves < abs(mean)]
    needed = int(enough[0]) if len(enough) else None
    return Difference(mean, mean - half, mean + half, seeds, meshes, needed)
