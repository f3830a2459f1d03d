"""Scores of an epoch without the target's labels, and which epoch is reported.

Rules of `selection.student`, by name:

    last        the last epoch. Nothing is computed.
    pseudo_val  accuracy on pseudo-labelled target clouds that were held out of the last round, as
                in QS3's released code (there in each round; see `hold_out`).
    entropy     three scores that need no labels at all, of the predictions for the target's
    infomax     training clouds: [n, K] probabilities to one number in nats.
    snd

The earliest epoch wins a tie.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.errors import ConfigError

LAST = "last"
PSEUDO_VAL = "pseudo_val"

TEMPERATURE = 0.05
"""Temperature of the soft neighbourhood density, as in its paper and code."""

_HELD_OUT = 5  # one of so many: the 20 % of QS3's released code
_BLOCK = 512  # rows of similarities at once: 33 MB for 8,000 clouds


def entropy(probabilities: Float[np.ndarray, "n k"]) -> float:
    """Mean entropy of the predictions, in [0, ln K]: lower is better.

    1/n Σ_i H(p_i) with H(p) = -Σ_k p_k ln p_k. A net that puts all clouds into one class, with
    certainty, has the best value there is.

    Morerio et al., "Minimal-Entropy Correlation Alignment for Unsupervised Deep Domain
    Adaptation", ICLR 2018, chooses a hyper-parameter by it.
    """
    from scipy.special import entr  # late: train.py imports this module before it knows its data

    return float(entr(probabilities).sum(axis=1).mean())


def infomax(probabilities: Float[np.ndarray, "n k"]) -> float:
    """Mutual information of cloud and predicted class, in [0, ln K]: higher is better.

    H(1/n Σ_i p_i) - 1/n Σ_i H(p_i): predictions should be certain, and of all classes alike, so
    on a target whose classes are not equally frequent the truth has not the best value.

    Krause, Perona and Gomes, "Discriminative Clustering by Regularized Information Maximization",
    NIPS 2010; a validator in the library PyTorch Adapt (Musgrave, Belongie and Lim, 2022), where
    it is called IM.
    """
    mean = probabilities.mean(axis=0, keepdims=True)
    value = entropy(mean) - entropy(probabilities)  # < 0 by rounding alone
    return float(np.maximum(0.0, value))  # max() of Python's would make 0 of NaN


def snd(
    probabilities: Float[np.ndarray, "n k"], temperature: float = TEMPERATURE, block: int = _BLOCK
) -> float:
    """Soft neighbourhood density, in [0, ln(n - 1)]: higher is better. n >= 2.

    Each prediction is scaled to length 1, f_i = p_i / |p_i|, and looks at all others:
    P_ij = exp(f_i · f_j / τ) / Σ_{l≠i} exp(f_i · f_l / τ) for j ≠ i. The value is the mean over i
    of the entropy of P_i: how many neighbours a cloud has that are as close as the closest. As
    with `entropy`, one class for all has the best value there is.

    Saito et al., "Tune it the Right Way: Unsupervised Validation of Domain Adaptation via Soft
    Neighborhood Density", ICCV 2021 (arXiv 2108.10860), there with τ = 0.05 as well.

    Args:
        probabilities: rows that sum to 1.
        temperature: τ > 0.
        block: rows of the similarities that are in memory at once.
    """
    from scipy.special import entr, softmax

    n = len(probabilities)
    assert n > 1
    directions = probabilities / np.linalg.norm(probabilities, axis=1, keepdims=True)  # [n, K]
    total = 0.0
    for rows in np.array_split(np.arange(n), -(-n // block)):
        logits = directions[rows] @ directions.T / temperature  # [b, n]
        logits[np.arange(len(rows)), rows] = -np.inf
        total += entr(softmax(logits, axis=1)).sum()
    return float(np.clip(total / n, 0.0, math.log(n - 1)))


class Validator(NamedTuple):
    """A score without labels, and which way is better."""

    score: Callable[[Float[np.ndarray, "n k"]], float]
    higher_is_better: bool


LABEL_FREE: Mapping[str, Validator] = {
    "entropy": Validator(entropy, higher_is_better=False),
    "infomax": Validator(infomax, higher_is_better=True),
    "snd": Validator(snd, higher_is_better=True),
}
"""What a search may look at: no label of the target, and the same clouds in each trial."""

STUDENT_RULES = (LAST, PSEUDO_VAL, *LABEL_FREE)


def is_better(rule: str, score: float, best: float | None) -> bool:
    """Whether an epoch with `score` replaces the best one before it (None: there is none).

    Not on a tie. A score that is not a number loses to every number.
    """
    if best is None:
        return True
    if math.isnan(score) or math.isnan(best):
        return math.isnan(best) and not math.isnan(score)
    higher = rule not in LABEL_FREE or LABEL_FREE[rule].higher_is_better
    return score > best if higher else score < best


def hold_out(
    labels: Int[np.ndarray, " m"], ids: Sequence[str], seed: int
) -> Bool[np.ndarray, " m"]:
    """Which pseudo-labelled clouds are validated on: a fifth of each class, drawn at random.

    Of m_k clouds m_k / 5 to the nearest whole number, so a class with one or two of them keeps
    all. QS3's released code (train_QBST_sim2real.py, lines 312 to 315) takes positions 8 and 9 of
    every ten in a list sorted by class and confidence.

    Args:
        labels: pseudo-labels.
        ids: of the clouds, all different; their order does not matter to who is drawn.
        seed: of the draw.
    """
    rng = np.random.default_rng(seed)
    held = np.zeros(len(labels), dtype=bool)
    by_id = np.array(sorted(range(len(ids)), key=ids.__getitem__), dtype=int)
    for k in np.unique(labels):
        members = by_id[labels[by_id] == k]
        count = (len(members) + _HELD_OUT // 2) // _HELD_OUT
        held[rng.permutation(members)[:count]] = True
    return held


def chosen_in_words(chosen: str) -> str:
    """`selection.teacher` or `.student` of metrics.json for people, who count epochs from 1."""
    return re.sub(r"(?<=, epoch )\d+", lambda epoch: str(int(epoch[0]) + 1), chosen)


def check_objective(objective: Any) -> None:
    """Raise ConfigError of what a search must not look at; None: no search runs.

    By `pseudo_val` each trial would be judged on clouds that it selected itself.
    """
    if objective is not None and objective not in LABEL_FREE:
        raise ConfigError(
            f"objective={objective}: a search may not look at the target's labels, nor at clouds "
            f"that a trial chose; set objective={'|'.join(LABEL_FREE)}"
        )
