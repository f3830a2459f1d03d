"""What can be said about predictions whose labels nobody knows.

Three estimates of their accuracy, made from confidences alone, and what else hints at trouble.
All of them learn what a confidence means on labelled validation clouds of the source, and carry it
over to the target. That carries over only in part: clouds of another domain, or of no known class,
get high confidences too, so the estimates are too high as a rule. By how much was measured on
simulated targets: docs/how-to/predict.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize_scalar

from qs3.datamodules.clouds import Clouds
from qs3.evaluation.ood import limits, ood_reasons_of_all, relax_min_points
from qs3.evaluation.validators import entropies
from qs3.runs.metrics import AccuracyEstimates, Estimates

TURNS = 3
"""Rotations about the up axis besides none: by 90, 180 and 270 degrees."""

_LEAST_T, _MOST_T, _TINY = 0.05, 20.0, 1e-300
_LOOKED_AT = 300  # clouds of a domain, 3 ms each


def temperature(probabilities: Float[np.ndarray, "v c"], labels: Int[np.ndarray, " v"]) -> float:
    """The T in [0.05, 20] for which softmax(log p / T) has the least cross-entropy to the labels.

    Guo et al., "On Calibration of Modern Neural Networks", ICML 2017, section 4.2. log p equals
    the logits but for a constant of each row, which the softmax does not see. T > 1 makes less
    sure. No class changes. 20 (the least sure that can be) if the net is no better than chance.

    A label counts (v + 1) / (v + 2), the other classes share the rest (Laplace's rule of
    succession, as in Platt, "Probabilistic Outputs for Support Vector Machines", 1999, section
    2.2). Without that a net that makes no error on v clouds would be taken to make none at all.

    Args:
        probabilities: of held-out clouds, v >= 1.
        labels: theirs.
    """
    classes = probabilities.shape[1]
    rest = 1 / (len(labels) + 2)
    weights = np.full(probabilities.shape, rest / max(1, classes - 1))
    weights[np.arange(len(labels)), labels] = 1 - rest

    def loss(log_t: float) -> float:
        logs = np.log(np.maximum(scaled(probabilities, math.exp(log_t)), _TINY))
        # Exactly rounded, so that the order of clouds does not matter where the valley is flat.
        return -math.fsum((weights * logs).sum(axis=1)) / len(labels)

    # The loss is convex in 1 / T, so it has one valley in log T.
    found = minimize_scalar(loss, bounds=(math.log(_LEAST_T), math.log(_MOST_T)), method="bounded")
    return math.exp(found.x)


def scaled(probabilities: Float[np.ndarray, "n c"], t: float) -> Float[np.ndarray, "n c"]:
    """softmax(log p / t)."""
    logits = np.log(np.maximum(probabilities, _TINY)) / t
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)


def average_confidence(probabilities: Float[np.ndarray, "n c"]) -> float:
    """AC: the mean largest probability, an estimate of accuracy if these are calibrated.

    Called so in Garg et al., "Leveraging Unlabeled Data to Predict Out-of-Distribution
    Performance", ICLR 2022, section 4.1; Hendrycks and Gimpel, ICLR 2017.
    """
    return float(probabilities.max(axis=1).mean())


def thresholded_confidence(
    source: Float[np.ndarray, "v c"],
    labels: Int[np.ndarray, " v"],
    target: Float[np.ndarray, "n c"],
) -> float:
    """ATC: the share of target clouds whose score is at least t.

    The score is minus the entropy, Σ_k p_k ln p_k. t leaves as many source clouds below it as the
    net gets wrong (Garg et al., ICLR 2022, eq. 1 and 2, the variant with negative entropy). Of k
    errors in v clouds t is the (k + 1)-th smallest score, so with no error it is the smallest one.

    Args:
        source: probabilities of held-out source clouds.
        labels: theirs.
        target: probabilities of clouds without labels.
    """
    scores = np.sort(-entropies(source))
    wrong = int((source.argmax(axis=1) != labels).sum())
    if wrong == len(scores):
        return 0.0
    return float((-entropies(target) >= scores[wrong]).mean())


def difference_of_confidences(
    source: Float[np.ndarray, "v c"],
    labels: Int[np.ndarray, " v"],
    target: Float[np.ndarray, "n c"],
) -> float:
    """DoC: the source's accuracy, less what the mean confidence loses on the target; in [0, 1].

    acc_S - (AC_S - AC_T): Guillory et al., "Predicting with Confidence on Unseen Distributions",
    ICCV 2021, section 3, with the difference taken as it is and not through a regression.
    """
    accuracy = float((source.argmax(axis=1) == labels).mean())
    lost = average_confidence(source) - average_confidence(target)
    return min(1.0, max(0.0, accuracy - lost))


def rotation_agreement(
    first: Float[np.ndarray, "n c"], turned: Sequence[Float[np.ndarray, "n c"]]
) -> float:
    """The share of pairs (cloud, turn) with the class of the cloud as it is.

    How invariant a net is to what cannot change a class goes with its accuracy on shifted data:
    Deng, Gould and Zheng, "On the Strong Correlation Between Model Invariance and Generalization",
    NeurIPS 2022.
    """
    return float(np.mean([agreement(first, other) for other in turned]))


def agreement(a: Float[np.ndarray, "n c"], b: Float[np.ndarray, "n c"]) -> float:
    """The share of clouds for which both name one class.

    Two nets that were trained apart agree about as often as they are right (Jiang et al.,
    "Assessing Generalization of SGD via Disagreement", ICLR 2022); teacher and student were not.
    """
    return float((a.argmax(axis=1) == b.argmax(axis=1)).mean())


def estimates(
    source: Float[np.ndarray, "v c"],
    labels: Int[np.ndarray, " v"],
    target: Float[np.ndarray, "n c"],
) -> dict[str, float]:
    """The temperature of the source's clouds, and the three estimates after scaling by it."""
    t = temperature(source, labels)
    source, raw, target = scaled(source, t), target, scaled(target, t)
    return {
        "temperature": t,
        "mean_confidence": average_confidence(raw),
        "calibrated": average_confidence(target),
        "thresholded": thresholded_confidence(source, labels, target),
        "difference": difference_of_confidences(source, labels, target),
    }


@dataclass(frozen=True, eq=False)
class Said:
    """Class probabilities by one net.

    Attributes:
        validation: of labelled clouds that no warm-up was trained on.
        target: of the clouds that are judged.
    """

    validation: Float[np.ndarray, "v c"]
    target: Float[np.ndarray, "n c"]

    @property
    def finite(self) -> bool:
        """False of a net that has diverged."""
        return bool(np.isfinite(self.validation).all() and np.isfinite(self.target).all())


def estimate_accuracy(
    said: Said,
    labels: Int[np.ndarray, " v"],
    unlike_source: float,
    *,
    owner: str,
    classes: Sequence[str],
    teacher: Said | None = None,
    turned: Callable[[float], Float[np.ndarray, "n c"]] | None = None,
) -> AccuracyEstimates:
    """What `metrics.json` has under `quality`; `qs3.evaluation.estimates_text` says it as text.

    Looks at no label of the target. None where a figure does not exist (no teacher, no gravity), or
    is not finite because the net has diverged.

    Args:
        said: by the reported net.
        labels: of the validation clouds.
        unlike_source: `ood_fraction` of the clouds that are judged.
        owner: of the labels, "source" or "target_train".
        classes: names in label order.
        teacher: by the net before self-training; None if there was none.
        turned: by the reported net of the judged clouds after a rotation about z by an angle in
            radians; None if z does not point up in them.
    """
    counts = np.bincount(said.target.argmax(axis=1), minlength=len(classes))
    about: dict[str, Any] = {
        "clouds": len(said.target),
        "validated_on": f"{owner}_val",
        "validation_clouds": len(labels),
        "validation_accuracy": agreement(said.validation, np.eye(len(classes))[labels]),
        "unlike_source": unlike_source,
        "never_predicted": [name for name, n in zip(classes, counts, strict=True) if not n],
    }
    if not said.finite:
        return AccuracyEstimates(**about)
    about |= estimates(said.validation, labels, said.target)
    if turned is not None:
        turns = [2 * math.pi * i / (TURNS + 1) for i in range(1, TURNS + 1)]
        about["rotation_agreement"] = rotation_agreement(said.target, [*map(turned, turns)])
    if teacher is not None:
        about["teacher_agrees"] = agreement(said.target, teacher.target)
        if teacher.finite:
            accuracy = agreement(teacher.validation, np.eye(len(classes))[labels])
            found = estimates(teacher.validation, labels, teacher.target)
            about["teacher"] = Estimates(validation_accuracy=accuracy, **found)
    return AccuracyEstimates(**about)


def ood_fraction(clouds: Clouds, source: Clouds) -> float:
    """The share of clouds outside the usual range of the source's.

    At most 300 of each are looked at, evenly spaced.
    """
    found = ood_reasons_of_all(clouds, source_ranges(source, _LOOKED_AT), most=_LOOKED_AT)
    return sum(map(bool, found)) / len(found)


def source_ranges(source: Clouds, most: int = 1000) -> dict[str, list[float]]:
    """Range of each measure in at most `most` clouds; of points no more than the net sees."""
    seen = source.stored.shape[1] if source.order is None else source.order.shape[2]
    return relax_min_points(limits(source, most=most), seen)
