"""How good predictions are without labels: what a search may look at."""

import re

import numpy as np
from jaxtyping import Float


def infomax(probabilities: Float[np.ndarray, "n k"]) -> float:
    """Mutual information of cloud and predicted class, in [0, ln K]: higher is better.

    H(1/n Σ_i p_i) - 1/n Σ_i H(p_i): predictions should be certain, and of all classes alike, so
    on a target whose classes are not equally frequent the truth has not the best value.

    Krause, Perona and Gomes, "Discriminative Clustering by Regularized Information Maximization",
    NIPS 2010; a validator in the library PyTorch Adapt (Musgrave, Belongie and Lim, 2022), where
    it is called IM.
    """
    mean = probabilities.mean(axis=0, keepdims=True)
    return float(np.maximum(0.0, _entropy(mean) - _entropy(probabilities)))  # max() loses NaN


def _entropy(probabilities: Float[np.ndarray, "n k"]) -> float:
    """The rows' mean entropy, in nats."""
    logs = np.log(np.where(probabilities == 0, 1, probabilities))
    return float(-(probabilities * logs).sum(axis=1).mean())


def chosen_in_words(chosen: str) -> str:
    """`selection.teacher` of metrics.json for people, who count epochs from 1."""
    return re.sub(r"(?<=, epoch )\d+", lambda epoch: str(int(epoch[0]) + 1), chosen)
