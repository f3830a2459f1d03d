"""Learning rates over a run: each phase begins anew with the optimiser's own.

- "cosine": from it towards 0 along a half cosine, as in the paper's code.
- "plateau": halved when the training loss has not fallen for more than 10 epochs, down to 1e-5, as
  in SimpleView's protocols (Goyal et al., ICML 2021; its code: torch's ReduceLROnPlateau).
"""

from __future__ import annotations

from typing import Any

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, ReduceLROnPlateau

from qs3.datamodules.phases import Phases

PLATEAU_FACTOR, PLATEAU_PATIENCE, PLATEAU_MIN_LR = 0.5, 10, 1e-5


class Plateau:
    """Steps by hand at the end of an epoch: Lightning would step after the epoch's checkpoint.

    Args:
        optimizer: with the rates to begin with.
    """

    def __init__(self, optimizer: Optimizer) -> None:
        self.optimizer = optimizer
        self._rates = [group["lr"] for group in optimizer.param_groups]
        self._restart()

    def _restart(self) -> None:
        self._scheduler = ReduceLROnPlateau(
            self.optimizer,
            factor=PLATEAU_FACTOR,
            patience=PLATEAU_PATIENCE,
            min_lr=PLATEAU_MIN_LR,
        )

    def start_phase(self) -> None:
        """The first rates again, and no memory of losses."""
        for group, rate in zip(self.optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate
        self._restart()

    def step(self, loss: float) -> None:
        """At the end of an epoch with this mean training loss."""
        self._scheduler.step(loss)

    def state_dict(self) -> dict[str, Any]:
        """What a resume needs besides the optimiser's state, which holds the rates."""
        known = self._scheduler.state_dict()
        return {key: known[key] for key in ("best", "num_bad_epochs", "cooldown_counter")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        self._scheduler.load_state_dict(state)


def cosine(optimizer: Optimizer, phases: Phases) -> LambdaLR:
    """The half cosine of each phase, stepped by Lightning."""
    return LambdaLR(optimizer, phases.cosine)
