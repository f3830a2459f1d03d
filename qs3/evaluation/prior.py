"""How common classes are where clouds without labels come from.

A net has learnt how common classes were in its training, which is as likely as not every
class alike; in rooms two things in five are chairs. With p the net's probabilities, u the classes'
shares in training and q those where the clouds come from,

    p'_k ~ p_k (q_k / u_k)^t.

t = 1 is Bayes' rule for classes that look the same in both places (Saerens, Latinne, Decaestecker,
"Adjusting the Outputs of a Classifier to New a Priori Probabilities", Neural Computation 14, 2002);
t as a choice is Menon et al., "Long-tail learning via logit adjustment", ICLR 2021.
`estimate_shares` finds q from clouds without labels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from qs3.classes import CLASSES, known_as
from qs3.errors import ConfigError

ESTIMATED = "estimated"
"""In a config: shares of the target's training clouds, by `estimate_shares`."""

POWER = 0.5
"""t: on real objects half of it is right more often than all of it (docs/how-to/predict.md)."""

ROOMS: dict[str, int] = dict(
    zip(CLASSES, (98, 329, 464, 650, 2578, 161, 210, 88, 495, 1037), strict=True)
)
"""Objects of each class in the rooms of ScanNet10's training part (PointDA-10, Qin et al. 2019)."""

TEMPERATURE = 2.0
"""T: chosen on real objects of the part for training, with their labels."""

MORE = 5.0
"""m: as many clouds more of each class."""

_STEPS, _CLOSE = 10_000, 1e-9


@dataclass(frozen=True, eq=False)
class Prior:
    """How much commoner classes are than in training: q by class, of sum 1, and t.

    `factors` are (q_k / u_k)^t, the largest of them 1.
    """

    shares: dict[str, float]
    power: float
    factors: Float[np.ndarray, " c"]

    def __call__(self, probabilities: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
        """The same with these classes as common.

        Of a cloud of impossible classes all possible ones are alike; NaN, of a net that diverged,
        stays NaN.
        """
        weighed = probabilities * self.factors
        total = weighed.sum(axis=1, keepdims=True)
        possible = (self.factors > 0) / np.count_nonzero(self.factors)
        known = np.where(total > 0, weighed / np.where(total > 0, total, 1), possible)
        return np.where(np.isnan(total), np.nan, known)

    @property
    def words(self) -> str:
        """The shares, the largest first."""
        order = sorted(self.shares.items(), key=lambda pair: -pair[1])
        shown = ", ".join(f"{name} {share:.1%}" for name, share in order)
        return f"classes count as this common, at power {self.power:g} (prior=): {shown}"


def read_prior(
    given: str | Mapping[str, float],
    classes: Sequence[str],
    learnt: Float[np.ndarray, " c"] | None = None,
    power: float = POWER,
) -> Prior:
    """A prior as it is given.

    Args:
        given: "rooms", as in `ROOMS`; or classes and how common they are, in any unit, as
            "chair:4,table:2,bathtub:0" or as a mapping, such as the `prior_shares` of a
            metrics.json: those that are not named count as 1, and 0 is never.
        classes: that the net knows.
        learnt: u, shares of the classes in its training, each above 0; None: all alike.
        power: t >= 0.
    """
    common: dict[str, float] = {}
    try:
        if given == "rooms":
            given = {name: ROOMS[name] for name in classes}
        elif isinstance(given, str):
            pairs = (part.rsplit(":", 1) for part in given.strip().strip("{}").split(","))
            given = {name: float(x) for name, x in pairs}
        assert not isinstance(given, str)
        for word, value in given.items():
            name = known_as(str(word).strip().strip("\"'"), classes)
            if name is None or name in common:
                raise ValueError(f"{word} is not a class, or named twice")
            common[name] = float(value)
        here = np.array([common.get(name, 1.0) for name in classes], dtype=np.float64)
        if not (power >= 0 and np.isfinite(here).all() and here.min() >= 0 and here.any()):
            raise ValueError("needs numbers from 0 on, one of them above 0")
    except (TypeError, ValueError, KeyError) as error:
        raise ConfigError(
            f"prior={given}: {error}; give rooms, or chair:4,table:2 of {', '.join(classes)}"
        ) from None
    here /= here.max()  # sums of huge numbers are none
    shares = here / here.sum()
    if learnt is None:
        learnt = shares_of([], len(classes))
    there = shares > 0  # 0 stays 0 at power 0, too
    log = np.log(np.where(there, shares, 1.0)) - np.log(learnt)
    log -= log[there].max()
    factors = np.where(there, np.exp(power * np.minimum(log, 0.0)), 0.0)
    return Prior(dict(zip(classes, shares.tolist(), strict=True)), power, factors)


def shares_of(labels: Int[np.ndarray, " n"] | Sequence[int], classes: int) -> np.ndarray:
    """Shares [C] of the classes among labels, one more of each so that none is 0."""
    counts = np.bincount(np.asarray(labels, dtype=np.int64), minlength=classes) + 1.0
    return counts / counts.sum()


def estimate_shares(
    probabilities: Float[np.ndarray, "n c"],
    learnt: Float[np.ndarray, " c"],
    temperature: float = TEMPERATURE,
    more: float = MORE,
) -> Float[np.ndarray, " c"]:
    """The classes' shares among clouds without labels, by expectation maximisation.

    l_ik = (p_ik / u_k)^(1/T) is how well class k explains cloud i; found are

        q = argmax_q sum_i log sum_k q_k l_ik + m sum_k log q_k.

    With T = 1 and m = 0 that is Saerens et al. (see the module). It takes the net at its word; of
    real scans nets are surer than they are right, and T = 2 leaves room for that. m keeps a class
    that is never predicted from being impossible (a Dirichlet prior).

    Args:
        probabilities: p, n >= 0. Clouds with a NaN, of a net that diverged, are left out; without
            any, q is u.
        learnt: u, each above 0, of sum 1.
        temperature: T > 0.
        more: m >= 0.
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
