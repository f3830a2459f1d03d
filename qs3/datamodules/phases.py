"""How self-training is run: which epochs belong to which phase, and the settings of its rounds.

Light (no torch), so that a wrong setting is an error within a second of starting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.config.checks import check_choice, check_float, check_int
from qs3.errors import ConfigError
from qs3.utils.plural import counted

LOWER_THETA = "lower selftraining.theta"
"""What selects more where a scheme has nothing else for it, in messages."""

RAISE_SHARE = "raise selftraining.share"
"""The same of a scheme whose threshold is set by a share."""


@dataclass(frozen=True)
class Phases:
    """The epochs of one `Trainer.fit`: a warm-up, then rounds of equal length.

    Phase 0 is the warm-up, phase r + 1 is round r. All epochs count from 0.

    Attributes:
        warmup: epochs of the warm-up.
        rounds: their number.
        epochs: of each round.
        warmup_steps, round_steps: batches of the warm-up and of each round, spread evenly over its
            epochs; None: an epoch is one pass over what is trained on.
    """

    warmup: int
    rounds: int = 0
    epochs: int = 0
    warmup_steps: int | None = None
    round_steps: int | None = None

    def __post_init__(self) -> None:
        check_int("protocol.epochs", self.warmup, 1)
        _check_steps("protocol", self.warmup_steps, self.warmup)
        if self.rounds:
            _check_steps("selftraining", self.round_steps, self.epochs)

    @property
    def total(self) -> int:
        """Number of epochs in all."""
        return self.warmup + self.rounds * self.epochs

    def phase(self, epoch: int) -> int:
        """0 in the warm-up, r + 1 in round r (an epoch past the end is in the last phase)."""
        if epoch < self.warmup or self.rounds == 0:
            return 0
        return 1 + min((epoch - self.warmup) // self.epochs, self.rounds - 1)

    def span(self, phase: int) -> tuple[int, int]:
        """First epoch of a phase, and the first one after it."""
        if phase == 0:
            return 0, self.warmup
        start = self.warmup + (phase - 1) * self.epochs
        return start, start + self.epochs

    def starts(self, epoch: int) -> bool:
        """Whether `epoch` is the first of its phase."""
        return self.span(self.phase(epoch))[0] == epoch

    def ends(self, epoch: int) -> bool:
        """Whether `epoch` is the last of its phase."""
        return self.span(self.phase(epoch))[1] == epoch + 1

    def steps(self, epoch: int) -> tuple[int, int] | None:
        """First batch of an epoch and the first one after it, counted from its phase's beginning.

        None where an epoch is one pass.
        """
        phase = self.phase(epoch)
        steps = self.warmup_steps if phase == 0 else self.round_steps
        if steps is None:
            return None
        start, stop = self.span(phase)
        done, epochs = epoch - start, stop - start
        return steps * done // epochs, steps * (done + 1) // epochs

    def cosine(self, epoch: int) -> float:
        """Factor on the learning rate: from 1 towards 0 along a half cosine, in each phase anew."""
        start, stop = self.span(self.phase(epoch))
        return 0.5 * (1.0 + math.cos(math.pi * (epoch - start) / (stop - start)))


def plain_epochs(plain: float, epochs: int) -> int:
    """The first epoch with a pool (`method=pcfea`): ceil(plain epochs), in decimal arithmetic.

    So 0.07 of 100 epochs are 7, whose product in binary is just above.

    Raises:
        ConfigError: there is none among the `epochs`.
    """
    first = math.ceil(Decimal(repr(float(plain))) * epochs)
    if first >= epochs:
        raise ConfigError(
            f"method.plain={plain} of protocol.epochs={epochs}, rounded up, is all of them: "
            "method=pcfea would make no pool and be source_only under another name; give more "
            "protocol.epochs or a lower method.plain, or set method=source_only"
        )
    return first


def _check_steps(group: str, steps: int | None, epochs: int) -> None:
    if steps is not None and check_int(f"{group}.steps", steps, 1) < epochs:
        raise ConfigError(
            f"{group}.steps={steps} must be at least {group}.epochs={epochs}, one an epoch"
        )


@dataclass(frozen=True)
class SelfTrainingConfig:
    """The settings of config group `selftraining`.

    Attributes:
        selector: a `qs3.selftraining.selectors.Selector`.
        rounds: number of rounds; 0 is not self-training.
        epochs: of each round.
        steps: batches of each round, spread over its epochs, however many pseudo-labels there are;
            None: an epoch is one pass over them.
        batch_size: of each round.
        theta: confidence that a pseudo-label must exceed, in round 0; 0 is for selectors that have
            thresholds of their own (CBST), and for them alone.
        epsilon: added to theta in each further round.
        share: instead of theta and epsilon, of each round's predictions the share that exceeds its
            threshold: where nets are unsure of everything, 0.8 says nothing. None: theta.
        init: "scratch" draws new weights each round; "continue" begins round 0 with the weights of
            the teacher that labelled it, and each further round with the student before;
            "persistent" draws new weights in round 0 alone, and keeps them and the optimiser's
            moments from then on, as in QS3's released code.
        use_source: whether labelled source clouds are trained on in the rounds, too.
        pcm: whether the student's clouds are mixed (see `qs3.methods.pcm`).
        weight_step: by how much the weight of both losses falls each epoch of the rounds, from 1
            (GAST's code: 0.005; both fall alike, so only its relation to the weight decay matters).
        mrkld: weight of CRST's regulariser (see `qs3.selftraining.student_loss`); 0 is none.
        missing_class: what to do if a class has no pseudo-label: "warn" or "error".
        rehearsal: train on all target samples, whatever the selector keeps (`debug=fast`).
    """

    selector: Any = None
    rounds: int = 0
    epochs: int = 10
    steps: int | None = None
    batch_size: int = 32
    theta: float = 0.8
    epsilon: float = 0.0
    share: float | None = None
    init: str = "scratch"
    use_source: bool = False
    pcm: bool = False
    weight_step: float = 0.0
    mrkld: float = 0.0
    missing_class: str = "warn"
    rehearsal: bool = False

    def __post_init__(self) -> None:
        check_int("selftraining.rounds", self.rounds, 0)
        if self.rounds == 0:
            return
        if not hasattr(self.selector, "select"):
            raise ConfigError("selftraining.rounds > 0 needs a selector, e.g. selftraining=qbst")
        check_int("selftraining.epochs", self.epochs, 1)
        check_int("selftraining.batch_size", self.batch_size, 2)  # batch norm needs two clouds
        check_choice("selftraining.init", self.init, ("scratch", "continue", "persistent"))
        check_choice("selftraining.missing_class", self.missing_class, ("warn", "error"))
        check_float("selftraining.epsilon", self.epsilon)
        if getattr(self.selector, "begins_weightless", False) and not self.use_source:
            raise ConfigError(
                "selftraining.selector.unsure=0 and selftraining.use_source=false: in round 0 no "
                "label is sure, all weigh nothing, and the next teacher would have learnt nothing; "
                "set selftraining.use_source=true, or selftraining.selector.unsure above 0"
            )
        free = bool(getattr(self.selector, "own_thresholds", False)) and self.theta == 0
        check_float("selftraining.theta", self.theta, "" if free else "(0, 1)")
        if self.share is not None:
            check_float("selftraining.share", self.share, "(0, 1)")
            if free:
                raise ConfigError(
                    "selftraining.share sets a threshold for all classes, and this selector has "
                    "its own; set selftraining.share=null"
                )
        check_float("selftraining.mrkld", self.mrkld, ">= 0")
        epochs = self.rounds * self.epochs
        step = check_float("selftraining.weight_step", self.weight_step)
        if not 0.0 <= step * (epochs - 1) < 1.0:
            raise ConfigError(
                "selftraining.weight_step must be >= 0, and below 1 after "
                f"{counted(epochs - 1, 'epoch')}, got {self.weight_step}"
            )
        last = self.theta_of(self.rounds - 1)
        if not (0.0 < last < 1.0 or (free and last == 0)):
            raise ConfigError(
                f"selftraining.theta + epsilon * (rounds - 1) must lie in (0, 1), got {last} "
                f"(theta={self.theta}, epsilon={self.epsilon}, rounds={self.rounds})"
            )

    @property
    def more_labels(self) -> tuple[str, ...]:
        """What would select more, as messages advise it: of the threshold, of the selector."""
        own = getattr(self.selector, "more_labels", None)
        threshold = LOWER_THETA if self.share is None else RAISE_SHARE
        # At 0 there is no other threshold than the selector's, if it has any.
        return tuple(way for way in (threshold if self.theta else None, own) if way)

    @property
    def instead_of_mu(self) -> str | None:
        """What selects more where one class alone is confident; None: the selector has no mu."""
        return getattr(self.selector, "instead_of_mu", None)

    def theta_of(self, round_: int, confidence: Float[np.ndarray, " n"] | None = None) -> float:
        """Threshold of a round, in decimal arithmetic: 0.8 + 9 * 0.005 is 0.845 exactly.

        With `share` it is a quantile of the round's `confidence`, and the highest ones exceed it
        even where more than that share of them are equal.
        """
        if self.share is not None and confidence is not None:
            quantile = np.quantile(confidence, 1 - self.share)
            return float(min(quantile, np.nextafter(confidence.max(), 0)))
        return float(Decimal(repr(self.theta)) + round_ * Decimal(repr(self.epsilon)))


def no_rounds(**ignored: Any) -> SelfTrainingConfig:
    """No self-training, whatever an experiment file has set for the rounds it would have had."""
    return SelfTrainingConfig(rounds=0)
