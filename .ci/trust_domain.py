"""A candidate for `qs3.evaluation.trust`: whether a classifier tells clouds from a net's own.

It sees what the net's last layer is given of held-out labelled clouds and of a target's, without
any label but the side: a proxy of the distance between domains (Ben-David et al., "A theory of
learning from different domains", Machine Learning 79, 2010). `.ci/trust_cases.py` asks it.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import rankdata

from qs3.errors import DataError
from qs3.evaluation.metrics import said_of

FOLDS, BATCH = 5, 32


def last_inputs(net: torch.nn.Module, points: torch.Tensor) -> Float[np.ndarray, "n d"]:
    """What the net's last linear layer is given of each cloud, float64, in eval mode.

    Raises:
        DataError: it has none, or does not use it once in a pass.
    """
    layers = [module for module in net.modules() if isinstance(module, torch.nn.Linear)]
    given: list[torch.Tensor] = []

    def of_batch(x: torch.Tensor) -> tuple[torch.Tensor]:
        given.clear()
        net(x)
        if len(given) != 1 or given[0].shape[:1] != x.shape[:1] or given[0].ndim != 2:
            raise DataError(f"{type(net).__name__}: no last linear layer of one vector a cloud")
        return (given[0],)

    if not layers:
        raise DataError(f"{type(net).__name__} has no linear layer")
    hook = layers[-1].register_forward_pre_hook(lambda _, args: given.append(args[0]))
    try:
        (found,) = said_of(net, of_batch, points, BATCH)
    finally:
        hook.remove()
    return found.numpy()


def told_apart(first: Float[np.ndarray, "m d"], second: Float[np.ndarray, "n d"]) -> float:
    """2 AUC - 1 of a linear discriminant on clouds that it was not fitted on, in [0, 1].

    0: no better than by chance (or worse); 1: every cloud of the second lies beyond every one of
    the first. AUC is the mean over five folds, each of every fifth row of both.

    Raises:
        DataError: of fewer than two rows a fold.
    """
    if min(len(first), len(second)) < 2 * FOLDS:
        raise DataError(f"{len(first)} and {len(second)} clouds: at least {2 * FOLDS} of each")
    found = []
    for fold in range(FOLDS):
        held = [np.arange(len(x)) % FOLDS == fold for x in (first, second)]
        direction = discriminant(first[~held[0]], second[~held[1]])
        found.append(auc(first[held[0]] @ direction, second[held[1]] @ direction))
    return max(0.0, 2 * float(np.mean(found)) - 1)


def discriminant(
    first: Float[np.ndarray, "m d"], second: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, " d"]:
    """Fisher's direction from the first's mean to the second's.

    Columns are in units of their spread within a side, and the common covariance is shrunk towards
    their mean variance (Ledoit, Wolf, J. Multivariate Analysis 88, 2004), so that there may be more
    columns than rows.
    """
    apart = second.mean(axis=0) - first.mean(axis=0)
    within = np.concatenate([x - x.mean(axis=0) for x in (first, second)])  # [m + n, d]
    spread = within.std(axis=0)
    unit = np.where(spread > 0, spread, 1.0)
    return np.linalg.solve(shrunk(within / unit), apart / unit) / unit


def shrunk(rows: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "d d"]:
    """Ledoit's and Wolf's covariance of centred rows: (1 - a) S + a m I, m the mean variance."""
    n, d = rows.shape
    covariance = rows.T @ rows / n
    mean = np.trace(covariance) / d or 1.0  # constant rows: the identity
    target = mean * np.eye(d)
    far = ((covariance - target) ** 2).sum()
    noise = ((rows**2).sum(axis=1) ** 2).sum() / n**2 - (covariance**2).sum() / n
    a = 1.0 if far <= 0 else min(1.0, max(1e-6, noise / far))
    return (1 - a) * covariance + a * target


def auc(first: Float[np.ndarray, " m"], second: Float[np.ndarray, " n"]) -> float:
    """How often a value of the second is the larger one of a pair; a tie counts half."""
    m, n = len(first), len(second)
    ranks = rankdata(np.concatenate([first, second]))
    return float((ranks[m:].sum() - n * (n + 1) / 2) / (m * n))
