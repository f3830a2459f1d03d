"""How long a run has taken, over all of its starts."""

from __future__ import annotations

import time
from typing import Any

from lightning.pytorch import Callback


class Clock(Callback):
    """Counts on from the checkpoint that a run continues.

    What was done between a checkpoint and a kill is done again, and counts once. A warm-up that was
    taken from another run (`qs3.training.shared_warmup`) brings its time along: the sum is what
    the run would have taken alone, up to the speed of the machine.

    Args:
        began: `time.time()` at this start, before the data were loaded.
    """

    def __init__(self, began: float) -> None:
        self.began = began
        self.before = 0.0

    def seconds(self) -> float:
        """Wall time so far."""
        return self.before + time.time() - self.began

    def state_dict(self) -> dict[str, Any]:
        """Seconds so far."""
        return {"seconds": self.seconds()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the seconds of earlier starts."""
        self.before = float(state_dict["seconds"])
