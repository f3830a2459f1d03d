"""How common the classes were in what a net learnt from, and the prior that is weighed against it.

See `qs3.evaluation.prior`, whose u these are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from omegaconf import OmegaConf

from qs3.datamodules.adaptation import AdaptationData
from qs3.datamodules.phases import SelfTrainingConfig
from qs3.evaluation.prior import ESTIMATED, Prior, estimate_shares, read_prior, shares_of
from qs3.runs.metrics import RoundRecord

Shares = Float[np.ndarray, " c"]


def of_labelled(data: AdaptationData, classes: int) -> Shares:
    """Of the labelled clouds, as `data.sampler` draws them."""
    if data.labelled_domain.sampler == "balanced":
        return shares_of([], classes)
    return shares_of(data.labelled.labels.numpy(), classes)


def of_student(scheme: SelfTrainingConfig, labelled: Shares, last: RoundRecord) -> Shares:
    """Of the last round's pseudo-labels; with as many of the source beside them, of both."""
    counts = list(last.selected.values())
    pseudo = shares_of(np.repeat(np.arange(len(counts)), counts), len(counts))
    return (pseudo + labelled) / 2 if scheme.use_source else pseudo


def prior_of(
    settings: Any,
    classes: Sequence[str],
    learnt: Shares,
    said: Callable[[], Float[np.ndarray, "n c"]],
) -> Prior | None:
    """`evaluation.prior` beside these shares; None if there is none.

    `said`: the net's probabilities of the target's training clouds, for shares that are estimated.

    Raises:
        ConfigError: it is no prior.
    """
    if settings.prior is None:
        return None
    given: Any = settings.prior
    if given == ESTIMATED:
        given = dict(zip(classes, estimate_shares(said(), learnt).tolist(), strict=True))
    given = OmegaConf.to_container(given) if OmegaConf.is_config(given) else given
    return read_prior(given, classes, learnt, settings.prior_power)
