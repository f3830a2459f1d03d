"""How many of a net's answers are right on clouds without labels, by how sure it is of them.

Confidences alone are too high on clouds of another kind, so the accuracy on held-out labelled
clouds is taken down by what is lost in confidence from there to here:

    logit(expected) = logit(a) - w max(0, logit(a) - logit(c)),

with a the accuracy on the held-out clouds and c the mean largest probability, calibrated on these
(`temperature`). w is fitted to 212 pairs of a net and a target, simulated and real, whose accuracy
is known: least squares of the logits, each target counting the same. Of the terms that were tried
(shapes of the clouds, frequencies of classes, ...) this one alone has the smallest error on a
target that is left out.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

WEIGHT = 1.7245
"""w."""

ERROR = 0.11
"""Mean of |expected - true accuracy| over the pairs, by weights that did not see their targets."""

FEWEST = 30
"""Of fewer clouds nothing is said: a mean confidence is too rough."""

_EDGE = 0.02  # shares nearer to 0 or 1 count as this
_LEAST_T, _MOST_T, _TINY = 0.05, 20.0, 1e-300


@dataclass(frozen=True)
class HeldOut:
    """What a net is on v held-out labelled clouds: (right + 1) / (v + 2), and `temperature`."""

    accuracy: float
    temperature: float


def held_out(
    probabilities: Float[np.ndarray, "v c"], labels: Int[np.ndarray, " v"]
) -> HeldOut | None:
    """What a net's answers to held-out labelled clouds say; None if it has diverged."""
    if not np.isfinite(probabilities).all():
        return None
    right = int((probabilities.argmax(axis=1) == labels).sum())
    return HeldOut((right + 1) / (len(labels) + 2), temperature(probabilities, labels))


def expected_accuracy(
    known: HeldOut | None, probabilities: Float[np.ndarray, "n c"]
) -> float | None:
    """The share of these answers that is expected to be right; None if nothing can be said."""
    if known is None or len(probabilities) < FEWEST or not np.isfinite(probabilities).all():
        return None
    sure = float(scaled(probabilities, known.temperature).max(axis=1).mean())
    base = _logit(known.accuracy)
    return 1 / (1 + math.exp(WEIGHT * max(0.0, base - _logit(sure)) - base))


def in_words(expected: float | None) -> str:
    """Such as "about 40 % expected right (±11)"; "" of None."""
    return "" if expected is None else f"about {expected:.0%} expected right (±{100 * ERROR:.0f})"


def temperature(probabilities: Float[np.ndarray, "v c"], labels: Int[np.ndarray, " v"]) -> float:
    """The T in [0.05, 20] for which softmax(log p / T) has the least cross-entropy to the labels.

    Guo et al., "On Calibration of Modern Neural Networks", ICML 2017, section 4.2. A label counts
    (v + 1) / (v + 2), the other classes share the rest (Laplace's rule of succession, as in Platt,
    "Probabilistic Outputs for Support Vector Machines", 1999, section 2.2): a net that makes no
    error on v >= 1 clouds is not taken to make none at all.
    """
    classes = probabilities.shape[1]
    rest = 1 / (len(labels) + 2)
    weights = np.full(probabilities.shape, rest / max(1, classes - 1))
    weights[np.arange(len(labels)), labels] = 1 - rest

    from scipy.optimize import minimize_scalar  # slow to import, and a command prints `in_words`

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


def _logit(share: float) -> float:
    """ln(p / (1 - p)) of p clipped to [0.02, 0.98]."""
    p = min(1 - _EDGE, max(_EDGE, share))
    return math.log(p / (1 - p))
