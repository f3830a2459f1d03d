"""How common classes are where clouds come from, and what that makes of a net's probabilities.

A net has learnt how common classes were in its training, which is as likely as not every class
alike; in rooms two things in five are chairs. With p the net's probabilities, u the classes' shares
in training and q those where the clouds come from,

    p'_k ~ p_k (q_k / u_k)^t.

t = 1 is Bayes' rule for classes that look the same in both places (Saerens, Latinne, Decaestecker,
"Adjusting the Outputs of a Classifier to New a Priori Probabilities", Neural Computation 14, 2002);
t as a choice is Menon et al., "Long-tail learning via logit adjustment", ICLR 2021. Nothing is
estimated here: `qs3.evaluation.share_estimates` does that, from clouds without labels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from qs3.classes import CLASSES, known_as
from qs3.config.checks import check_float
from qs3.errors import ConfigError

ESTIMATED = "estimated"
"""In a config: shares of the target's training clouds, see `qs3.evaluation.share_estimates`."""

POWER = 0.5
"""t: on real objects half of it is right more often than all of it (docs/how-to/predict.md)."""

ROOMS: dict[str, int] = dict(
    zip(CLASSES, (98, 329, 464, 650, 2578, 161, 210, 88, 495, 1037), strict=True)
)
"""Objects of each class in the rooms of ScanNet10's training part (PointDA-10, Qin et al. 2019)."""


_SHOWN = 12  # classes in words


@dataclass(frozen=True, eq=False)
class Prior:
    """How much commoner classes are than in training.

    Attributes:
        shares: [C] q >= 0, of sum 1.
        power: t.
        factors: [C] >= 0, one of them above 0: (q_k / u_k)^t, the largest of them 1.
        words: the shares, for people.
    """

    shares: Float[np.ndarray, " c"]
    power: float
    factors: Float[np.ndarray, " c"]
    words: str

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

    def told(self, classes: Sequence[str]) -> dict[str, Any]:
        """For a table in JSON."""
        return {
            "power": self.power,
            "shares": dict(zip(classes, self.shares.tolist(), strict=True)),
        }


def read_prior(
    given: str | Mapping[str, float],
    classes: Sequence[str],
    learnt: Float[np.ndarray, " c"] | None = None,
    power: float = POWER,
    key: str = "prior",
) -> Prior:
    """A prior as it is given.

    Args:
        given: "rooms", as in `ROOMS`; or classes and how common they are, in any unit, as
            "chair:4,table:2,bathtub:0" or as a mapping, or as a mapping's words, such as the
            `prior_shares` of a metrics.json: those that are not named count as 1, and 0 is never.
        classes: that the net knows.
        learnt: u, shares of the classes in its training, each above 0; None: all alike.
        power: t >= 0.
        key: what it is called where it is given, for messages.

    Raises:
        ConfigError: what is given is no such thing, or names a class that the net does not know.
    """
    power = check_float(f"{key}_power", power, ">= 0")
    if given == ESTIMATED:
        raise ConfigError(
            f"{key}={ESTIMATED} is for a run, `evaluation.prior={ESTIMATED}`: there are no clouds "
            f"to estimate shares from here. Its metrics.json has those that it found, under "
            f"prior_shares: give them, {_example(key)}"
        )
    if given == "rooms":
        given = _of_rooms(classes, key)
    if not isinstance(given, str | Mapping):
        raise ConfigError(f"{key}={given!r:.60} should be words or a mapping, {{'chair': 4}}")
    pairs = _pairs(given, key) if isinstance(given, str) else list(given.items())
    common: dict[str, float] = {}
    for word, value in pairs:
        name = known_as(str(word), classes)
        if name is None:
            raise ConfigError(f"{key}={word}: the classifier's classes are {', '.join(classes)}")
        if name in common:
            raise ConfigError(f"{key}= names {name} twice")
        common[name] = check_float(f"{key}={word}", value, ">= 0")
    here = np.array([common.get(name, 1.0) for name in classes], dtype=np.float64)
    if not here.any():
        raise ConfigError(f"{key}= leaves no class that there could be")
    here /= here.max()  # sums of huge numbers are none
    shares = here / here.sum()
    if learnt is None:
        learnt = shares_of([], len(classes))
    there = shares > 0  # 0 stays 0 at power 0, too
    log = np.log(np.where(there, shares, 1.0)) - np.log(learnt)
    log -= log[there].max()
    factors = np.where(there, np.exp(power * np.minimum(log, 0.0)), 0.0)
    return Prior(shares, power, factors, _in_words(shares, classes, power))


def shares_of(labels: Int[np.ndarray, " n"] | Sequence[int], classes: int) -> np.ndarray:
    """Shares [C] of the classes among labels, one more of each so that none is 0."""
    counts = np.bincount(np.asarray(labels, dtype=np.int64), minlength=classes) + 1.0
    return counts / counts.sum()


def check_told(prior: object, power: float, key: str = "prior") -> None:
    """Refuse a power that nothing reads. `key`: as of `read_prior`.

    Raises:
        ConfigError: it is not `POWER`, and there is no prior.
    """
    if not prior and power != POWER:
        raise ConfigError(
            f"{key}_power= is for {key}=; give {key}=rooms or {_example(key)}{_or_estimated(key)}"
        )


def _example(key: str) -> str:
    """As it is typed: Hydra, which reads keys with dots, takes no colons and commas."""
    return f"'{key}={{chair: 4, table: 2}}'" if "." in key else f"{key}=chair:4,table:2"


def _or_estimated(key: str) -> str:
    """In a config, where there are clouds to estimate from."""
    return f", or {ESTIMATED}" if "." in key else ""


def _of_rooms(classes: Sequence[str], key: str) -> dict[str, float]:
    if unknown := [name for name in classes if name not in ROOMS]:
        raise ConfigError(
            f"{key}=rooms knows {', '.join(ROOMS)}; the classifier also tells "
            f"{', '.join(unknown)}: say how common they are, {_example(key)}"
        )
    return {name: ROOMS[name] for name in classes}


def _pairs(words: str, key: str) -> list[tuple[str, float]]:
    pairs: list[tuple[str, float]] = []
    inner = words.strip()
    inner = inner[1:-1] if inner[:1] == "{" and inner[-1:] == "}" else inner
    for part in inner.split(","):
        name, colon, value = part.rpartition(":")
        name = name.strip().strip("\"'")
        if not colon or not name.strip():
            raise ConfigError(
                f"{key}={words}: {part.strip()!r} should be CLASS:NUMBER, as in "
                f"{_example(key)}; or say {key}=rooms{_or_estimated(key)}"
            )
        try:
            pairs.append((name.strip(), float(value)))
        except ValueError:
            raise ConfigError(
                f"{key}={words}: {value.strip()!r} after {name.strip()} should be a number"
            ) from None
    return pairs


def _in_words(shares: Float[np.ndarray, " c"], classes: Sequence[str], power: float) -> str:
    order = np.argsort(-shares, kind="stable")
    said = ", ".join(f"{classes[k]} {shares[k]:.1%}" for k in order[:_SHOWN])
    if len(order) > _SHOWN:
        said += f", and {len(order) - _SHOWN} more"
    return f"classes count as this common, at power {power:g} (prior=): {said}"
