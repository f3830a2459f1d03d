"""What a search or grid prints at its end: each trial, the best, the command that repeats it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from qs3.config.location import typed
from qs3.evaluation.validators import LABEL_FREE
from qs3.sweeps.search_space import overrides
from qs3.utils.text_table import aligned

FAILED = "failed"


@dataclass(frozen=True)
class Tried:
    """A trial.

    Attributes:
        number: of the trial.
        params: by key what was varied, in Hydra's grammar.
        value: of the objective; None if it failed or diverged.
        run: the name of its run, "failed" or "diverged: <name>".
    """

    number: int
    params: Mapping[str, str]
    value: float | None
    run: str

    @staticmethod
    def of(number: int, params: Mapping[str, str], value: float | None, run: str) -> Tried:
        """A trial with what `objective_of` said of its run: None if that failed, NaN: diverged."""
        if value is None:
            return Tried(number, params, None, FAILED)
        if not math.isfinite(value):
            return Tried(number, params, None, f"diverged: {run}")
        return Tried(number, params, value, run)


def report(headline: str, objective: str, tried: Sequence[Tried], fixed: Sequence[str]) -> str:
    """A table of all trials, in order, without any accuracy; `fixed`: overrides that all share."""
    keys = list(dict.fromkeys(key for one in tried for key in one.params))
    rows = [("trial", objective, *keys, "run")]
    for one in tried:
        value = "-" if one.value is None else f"{one.value:.4f}"
        values = (one.params.get(key, "-") for key in keys)
        rows.append((str(one.number), value, *values, one.run))
    lines = [headline, *aligned(rows)]
    judged = [one for one in tried if one.value is not None]
    if judged:
        sign = 1 if LABEL_FREE[objective].higher_is_better else -1
        best = max(judged, key=lambda one: sign * (one.value or 0.0))  # the first one wins a tie
        search = ("hparams_search=", "objective=", "seed=")
        kept = [word for word in fixed if not word.startswith(search)]
        command = shlex.join([*kept, *overrides(best.params), "seed=0,1,2"])
        lines.append(f"Best: trial {best.number}. With several seeds:")
        lines.append(typed(f"  python train.py -m {command}"))
    elif tried:
        lines.append(f"No trial has a finite {objective}, so there is no best one")
    return "\n".join(lines)
