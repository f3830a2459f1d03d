"""How many of a net's answers are right on clouds without labels, and whether to trust them at all.

Confidences alone are too high on clouds of another kind. What tells is how far these are from the
labelled ones: the accuracy on held-out labelled clouds is taken down by each shift that is seen,

    logit(expected) = logit(held-out accuracy) - sum_k w_k s_k,    w_k >= 0, s_k >= 0,

where every s_k is 0 if there is no shift. So no evidence ever raises an estimate, and clouds like
the held-out ones get these one's accuracy. The weights are few, and were fitted over many pairs of
source and target, simulated and real, whose accuracy is known: `qs3.evaluation.trust_file`.

An estimate under `LEAST_TRUSTED` is a refusal: "do not trust this".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from qs3.datamodules.clouds import Clouds
from qs3.errors import DataError
from qs3.evaluation.confidences import (
    average_confidence,
    scaled,
    temperature,
    thresholded_confidence,
)
from qs3.evaluation.ood import measure_one
from qs3.evaluation.trust_file import Calibration
from qs3.runs.metrics import Trust

COMPARED = ("spacing", "middle", "thickness", "height")
"""Measures of `qs3.evaluation.ood` in which clouds are compared; `points` depends on the file."""

LEAST_TRUSTED = 0.5
"""An expected accuracy under this is a refusal."""

FEWEST = 30
"""Of fewer clouds nothing is said: the shares above are too rough."""

MEASURED = 400
"""Clouds of a domain whose shape is measured, at most."""

_NEIGHBOUR, _TAIL, _EDGE = 5, 0.1, 0.02
_RIDGE = 0.05  # of the weights, in units of each shift's own spread


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of held-out labelled clouds, by which others are judged.

    Attributes:
        probabilities: [v, C] what the net says of them.
        labels: [v] what they are.
        measures: [m, 4] `COMPARED` of labelled clouds.
        turns: share with the same class after a quarter turn about the up axis; None: not known.
    """

    probabilities: Float[np.ndarray, "v c"]
    labels: Int[np.ndarray, " v"]
    measures: Float[np.ndarray, "m 4"]
    turns: float | None = None

    def __post_init__(self) -> None:
        v = len(self.labels)
        if v < 1 or self.probabilities.shape[:1] != (v,) or self.measures.shape[1:] != (4,):
            raise DataError(
                f"statistics of labelled clouds: probabilities {self.probabilities.shape}, labels "
                f"{self.labels.shape}, measures {self.measures.shape} do not belong together"
            )

    @property
    def accuracy(self) -> float:
        """On the held-out clouds, as (right + 1) / (v + 2): none of v is not certain."""
        right = int((self.probabilities.argmax(axis=1) == self.labels).sum())
        return (right + 1) / (len(self.labels) + 2)


@dataclass(frozen=True, eq=False)
class Seen:
    """What is seen of clouds without labels.

    Attributes:
        probabilities: [n, C] what the net says of them.
        measures: [m, 4] `COMPARED` of some or all of them.
        turns: as in `Known`; None: was not asked.
    """

    probabilities: Float[np.ndarray, "n c"]
    measures: Float[np.ndarray, "m 4"]
    turns: float | None = None


def shifts(known: Known, seen: Seen) -> dict[str, float]:
    """How far the clouds are from the labelled ones, by name: each >= 0, and 0 for not at all.

    `trust_file.SHIFTS` says what they are. Without `turns` these are left out.
    """
    t = temperature(known.probabilities, known.labels)
    source, target = scaled(known.probabilities, t), scaled(seen.probabilities, t)
    base = logit(known.accuracy)
    found = {
        "unsure": max(0.0, base - logit(average_confidence(target))),
        "thresholded": max(0.0, base - logit(thresholded_confidence(source, known.labels, target))),
        "answers": far_share(centred_logs(known.probabilities), centred_logs(seen.probabilities)),
        "shapes": far_share(known.measures, seen.measures),
        "outside": outside_share(known.measures, seen.measures),
        "counts": counts_apart(known.probabilities, seen.probabilities),
    }
    if seen.turns is not None and known.turns is not None:
        found["turns"] = max(0.0, known.turns - seen.turns)
    return found


def logit(share: float) -> float:
    """ln(p / (1 - p)) of p clipped to [0.02, 0.98], in [-3.9, 3.9]."""
    p = min(1 - _EDGE, max(_EDGE, share))
    return math.log(p / (1 - p))


def centred_logs(probabilities: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
    """Ln p about its mean of each row: a net's logits but for a constant a row, p >= 1e-12."""
    logs = np.log(np.maximum(probabilities, 1e-12))
    return logs - logs.mean(axis=1, keepdims=True)


def far_share(reference: Float[np.ndarray, "m d"], others: Float[np.ndarray, "n d"]) -> float:
    """The share of `others` farther from the reference than its own points are, in [0, 1].

    Far is a distance to the fifth neighbour in the reference over that of nine tenths of its own
    points to theirs (deep nearest neighbours: Sun et al., ICML 2022), each column in units of its
    standard deviation. That leaves a tenth if there is no shift: (share - 0.1) / 0.9, at least 0.
    A reference of several kinds has no outside between them.
    """
    spread = reference.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    reference, others = reference / spread, others / spread
    k = min(_NEIGHBOUR, len(reference) - 1)
    if k < 1:
        return 0.0
    tree = cKDTree(reference)
    own = tree.query(reference, k + 1)[0][:, -1]  # the first is the point itself
    theirs = tree.query(others, [k])[0][:, 0]
    far = float((theirs > np.quantile(own, 1 - _TAIL)).mean())
    return max(0.0, (far - _TAIL) / (1 - _TAIL))


def outside_share(reference: Float[np.ndarray, "m d"], others: Float[np.ndarray, "n d"]) -> float:
    """The share of `others` with a column outside the reference's range from 0.1 to 99.9 %."""
    low, high = np.quantile(reference, [0.001, 0.999], axis=0)
    return float(((others < low) | (others > high)).any(axis=1).mean())


def counts_apart(a: Float[np.ndarray, "v c"], b: Float[np.ndarray, "n c"]) -> float:
    """Total variation between how often each class is predicted, less what chance makes of none.

    Chance: E|p_k - q_k| of samples of these sizes from the common shares, normal approximation.
    """
    classes = a.shape[1]
    first, second = (np.bincount(x.argmax(axis=1), minlength=classes) for x in (a, b))
    share = (first + second) / (len(a) + len(b))
    deviation = np.sqrt(share * (1 - share) * (1 / len(a) + 1 / len(b)))
    chance = math.sqrt(2 / math.pi) * deviation.sum() / 2
    apart = np.abs(first / len(a) - second / len(b)).sum() / 2
    return max(0.0, float(apart - chance))


def expected(base: float, found: Mapping[str, float], weights: Mapping[str, float]) -> float:
    """The accuracy that is left of `base` after the shifts, in [0, 1].

    Raises:
        DataError: a weight's shift was not measured.
    """
    if missing := [name for name in weights if name not in found]:
        raise DataError(f"an estimate by {', '.join(weights)} lacks {', '.join(missing)}")
    z = logit(base) - sum(weight * found[name] for name, weight in weights.items())
    return 1 / (1 + math.exp(-z))


def fit_weights(
    names: Sequence[str],
    table: Float[np.ndarray, "n k"],
    base: Float[np.ndarray, " n"],
    truth: Float[np.ndarray, " n"],
    targets: Sequence[str],
) -> dict[str, float]:
    """The weights w_k >= 0 with the least squares of logit(truth) over cases, plus a small ridge.

    Every target counts the same, however many cases it has. The ridge is 0.05 (w_k sd_k)^2 with
    the standard deviation sd_k of the shift over the cases, whose weights sum to 1.

    Args:
        names: of the shifts, the table's columns.
        table: the shifts of each case.
        base: held-out accuracy of each case.
        truth: its accuracy on the target.
        targets: its target.
    """
    _, where, many = np.unique(np.array(targets), return_inverse=True, return_counts=True)
    weight = 1 / (many[where] * len(many))
    drop = np.array([logit(b) - logit(t) for b, t in zip(base, truth, strict=True)])
    ridge = np.diag(math.sqrt(_RIDGE) * table.std(axis=0))
    left = np.concatenate([np.sqrt(weight)[:, None] * table, ridge])
    right = np.concatenate([np.sqrt(weight) * drop, np.zeros(len(names))])
    return dict(zip(names, nnls(left, right)[0].tolist(), strict=True))


def judge(known: Known, seen: Seen, calibration: Calibration) -> Trust | None:
    """What to make of a net's answers; None of fewer than `FEWEST` clouds.

    Raises:
        DataError: a shift that the calibration asks for cannot be told from what was given.
    """
    if len(seen.probabilities) < FEWEST:
        return None
    found = shifts(known, seen)
    value = expected(known.accuracy, found, calibration.weights)
    return Trust(
        expected=value,
        trusted=value >= LEAST_TRUSTED,
        held_out=known.accuracy,
        shifts=found,
        lost={name: weight * found[name] for name, weight in calibration.weights.items()},
        error=calibration.mean_error,
        error_90=calibration.error_90,
    )


def compared(clouds: Clouds, most: int = MEASURED) -> Float[np.ndarray, "m 4"]:
    """`COMPARED` of at most `most` clouds, at even steps; 3 ms each."""
    chosen = np.unique(np.linspace(0, len(clouds) - 1, min(most, len(clouds)))).astype(int)
    found = [measure_one(clouds, int(i)) for i in chosen]
    return np.array([[each[name] for name in COMPARED] for each in found])
