"""How self-training is run: which epochs belong to which phase, and the settings of its rounds.

Light (no torch), so that a wrong setting is an error within a second of starting.
"""

import math
from dataclasses import dataclass
from decimal import Decimal
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Interval
from jaxtyping import Float

from qs3.errors import ConfigError
from qs3.utils.settings import settings


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
        unbroken: the rounds' learning rate swings on, as in QS3's released code: it falls in the
            first round, rises in the second, and so on.
    """

    warmup: int
    rounds: int = 0
    epochs: int = 0
    warmup_steps: int | None = None
    round_steps: int | None = None
    unbroken: bool = False

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
        phase = self.phase(epoch)
        start, stop = self.span(min(phase, 1) if self.unbroken else phase)
        return 0.5 * (1.0 + math.cos(math.pi * (epoch - start) / (stop - start)))


@settings
class SelfTrainingConfig:
    """The settings of config group `selftraining`.

    Attributes:
        selector: a `qs3.selftraining.selectors.Selector`.
        rounds: number of rounds; 0 is not self-training.
        epochs: of each round.
        steps: batches of each round, spread over its epochs, however many pseudo-labels there are;
            None: an epoch is one pass over them.
        batch_size: of each round; batch norm needs two clouds.
        theta: confidence that a pseudo-label must exceed, in round 0; 0 is for selectors that have
            thresholds of their own (CBST).
        epsilon: added to theta in each further round.
        share: instead of theta and epsilon, the share of the first teacher's predictions that
            exceeds the threshold of all rounds: where nets are unsure of everything, 0.8 selects
            next to nothing. None: theta.
        init: weights a round begins with. "scratch" draws new ones; "continue" begins round 0 with
            the teacher that labelled it, and each further round with the student before;
            "persistent" draws new weights in round 0 alone, and keeps them and the optimiser's
            moments from then on, as in QS3's released code.
        use_source: whether labelled source clouds are trained on in the rounds, too.
        pcm: whether the student's clouds are mixed (see `qs3.methods.pcm`).
        weight_step: by how much the weight of both losses falls each epoch of the rounds, from 1
            (GAST's code: 0.005; both fall alike, so only its relation to the weight decay matters).
        released: the rounds of QS3's released code, see `qs3.selftraining.released`.
        mrkld: weight of CRST's regulariser (see `qs3.selftraining.student`); 0 is none.
        rehearsal: train on all target samples, whatever the selector keeps (`debug=fast`).

    Raises:
        ConfigError: losses would have a weight of 0 or less in the last epochs.
    """

    selector: Any = None
    rounds: Annotated[int, Ge(0)] = 0
    epochs: Annotated[int, Ge(1)] = 10
    steps: Annotated[int, Ge(1)] | None = None
    batch_size: Annotated[int, Ge(2)] = 32
    theta: Annotated[float, Interval(ge=0, lt=1)] = 0.8
    epsilon: float = 0.0
    share: Annotated[float, Interval(gt=0, lt=1)] | None = None
    init: Literal["scratch", "continue", "persistent"] = "scratch"
    use_source: bool = False
    pcm: bool = False
    weight_step: Annotated[float, Ge(0)] = 0.0
    mrkld: Annotated[float, Ge(0)] = 0.0
    released: bool = False
    rehearsal: bool = False

    def __post_init__(self) -> None:
        if self.weight_step * (self.rounds * self.epochs - 1) >= 1:
            raise ConfigError(f"selftraining.weight_step={self.weight_step} falls to 0 in training")

    def theta_of(self, round_: int, confidence: Float[np.ndarray, " n"]) -> float:
        """Threshold of a round, in decimal arithmetic: 0.8 + 9 * 0.005 is 0.845 exactly.

        With `share` it is a quantile of `confidence`, the first teacher's, in all rounds; the
        highest ones exceed it even where more than that share of them are equal.
        """
        if self.share is not None:
            quantile = np.quantile(confidence, 1 - self.share)
            return float(min(quantile, np.nextafter(confidence.max(), 0)))
        return float(Decimal(repr(self.theta)) + round_ * Decimal(repr(self.epsilon)))


def no_rounds(**ignored: Any) -> SelfTrainingConfig:
    """No self-training, whatever an experiment file has set for the rounds it would have had."""
    return SelfTrainingConfig(rounds=0)
