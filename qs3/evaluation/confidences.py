"""Estimates of accuracy from confidences alone, as pure functions of tables of probabilities.

They learn what a confidence means on held-out labelled clouds, and carry it over to others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize_scalar

from qs3.evaluation.validators import entropies

_LEAST_T, _MOST_T, _TINY = 0.05, 20.0, 1e-300


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
