"""Whether a net is right as often as it says: the expected calibration error and its diagram."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

CALIBRATION_BINS = 15


@dataclass(frozen=True, eq=False)
class Reliability:
    """Confidence against accuracy in bins ((b-1)/B, b/B] of the largest probability.

    Guo et al., "On Calibration of Modern Neural Networks", ICML 2017, figure 1 and eq. 1 to 3.

    Attributes:
        count: [B] clouds in each bin.
        confidence: [B] their mean largest probability; NaN in an empty bin.
        accuracy: [B] the share that is right; NaN likewise.
        error: expected calibration error in [0, 1].
    """

    count: Int[np.ndarray, " b"]
    confidence: Float[np.ndarray, " b"]
    accuracy: Float[np.ndarray, " b"]
    error: float


def reliability(
    probabilities: Float[np.ndarray, "n c"],
    labels: Int[np.ndarray, " n"],
    bins: int = CALIBRATION_BINS,
) -> Reliability | None:
    """The diagram's figures; None if no cloud has a label. Clouds without one (-1) are left out."""
    known = labels >= 0
    if not known.any():
        return None
    probabilities, labels = probabilities[known], labels[known]
    confidence, right = probabilities.max(axis=1), probabilities.argmax(axis=1) == labels
    place = np.clip(np.ceil(confidence * bins).astype(int) - 1, 0, bins - 1)
    count = np.bincount(place, minlength=bins)
    some = np.where(count, count, 1)
    means = [
        np.where(count, np.bincount(place, weights=w, minlength=bins) / some, np.nan)
        for w in (confidence, right)
    ]
    gap = np.bincount(place, weights=right - confidence, minlength=bins)  # n_b (accuracy - conf.)
    return Reliability(count, means[0], means[1], float(np.abs(gap).sum() / len(labels)))


def calibration_error(
    probabilities: Float[np.ndarray, "n c"],
    labels: Int[np.ndarray, " n"],
    bins: int = CALIBRATION_BINS,
) -> float:
    """Expected calibration error in [0, 1]: how far confidence is from accuracy on average.

    ECE = Σ_b n_b / n |accuracy_b - confidence_b| over bins of equal width, ((b-1)/B, b/B], of the
    largest probability (Guo et al., "On Calibration of Modern Neural Networks", ICML 2017, eq. 3).
    """
    found = reliability(probabilities, labels, bins)
    assert found is not None
    return found.error
