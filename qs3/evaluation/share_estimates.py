"""How common classes are in a target, from what a net says of its unlabelled clouds.

With p the net's probabilities and u the classes' shares in its training, l_ik = (p_ik / u_k)^(1/T)
is how well class k explains cloud i, and the shares q are those that explain all clouds best,

    q = argmax_q sum_i log sum_k q_k l_ik + m sum_k log q_k,

found by expectation maximisation. With T = 1 and m = 0 that is Saerens, Latinne, Decaestecker,
"Adjusting the Outputs of a Classifier to New a Priori Probabilities", Neural Computation 14, 2002.
It takes the net at its word; but of real scans nets are surer than they are right, and then small
differences between classes grow with each step. T = 2 leaves room for that, and m keeps a class
that is never said from being impossible (a Dirichlet prior).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

TEMPERATURE = 2.0
"""T: chosen on real objects of the part for training, with their labels (docs/results/tried.md)."""

MORE = 5.0
"""m: as many clouds more of each class."""

_STEPS, _CLOSE = 10_000, 1e-9


def estimate_shares(
    probabilities: Float[np.ndarray, "n c"],
    learnt: Float[np.ndarray, " c"],
    temperature: float = TEMPERATURE,
    more: float = MORE,
) -> Float[np.ndarray, " c"]:
    """The classes' shares among these clouds.

    Args:
        probabilities: [n, c] p, n >= 0. Clouds with a NaN, of a net that diverged, tell nothing.
        learnt: [c] u, each above 0, of sum 1.
        temperature: T > 0.
        more: m >= 0.

    Returns:
        [c] q >= 0, of sum 1, each above 0 with `more`. `learnt` where no cloud tells anything.
    """
    known = probabilities[np.isfinite(probabilities).all(axis=1)]
    if not len(known):
        return learnt.copy()
    with np.errstate(divide="ignore"):
        logs = np.log(known / learnt) / temperature
    explains = np.exp(logs - logs.max(axis=1, keepdims=True))
    shares = learnt.copy()
    for _ in range(_STEPS):
        weighed = explains * shares
        weighed /= weighed.sum(axis=1, keepdims=True)
        new = (weighed.sum(axis=0) + more) / (len(known) + more * len(shares))
        done = np.abs(new - shares).max() < _CLOSE
        shares = new
        if done:
            break
    return shares
