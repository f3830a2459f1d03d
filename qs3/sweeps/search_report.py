"""What a search prints at its end: every trial, the best one, and the command that repeats it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from hydra.core.utils import JobReturn, JobStatus

from qs3.config import hashing
from qs3.config.location import typed
from qs3.report.tables.aggregate import align
from qs3.sweeps.search_space import overrides

FAILED = "failed"
DIVERGED = "diverged"


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
    def of(number: int, params: Mapping[str, str], result: JobReturn) -> Tried:
        """From what Hydra says of a job."""
        if result.status != JobStatus.COMPLETED:
            return Tried(number, params, None, FAILED)
        name, value = hashing.run_name(result.cfg), float(result.return_value)  # type: ignore[arg-type]
        if not math.isfinite(value):  # see `qs3.training.command.objective_of`
            return Tried(number, params, None, f"{DIVERGED}: {name}")
        return Tried(number, params, value, name)


def report(
    headline: str, objective: str, lower: bool, tried: Sequence[Tried], fixed: Sequence[str]
) -> str:
    """A table of all trials, without a look at any accuracy.

    Args:
        headline: first line.
        objective: name.
        lower: whether low values are the good ones.
        tried: in the order of their numbers.
        fixed: overrides that all of them share.
    """
    keys = list(dict.fromkeys(key for one in tried for key in one.params))
    rows = [("trial", objective, *keys, "run")]
    for one in tried:
        value = "-" if one.value is None else f"{one.value:.4f}"
        values = (one.params.get(key, "-") for key in keys)
        rows.append((str(one.number), value, *values, one.run))
    words = [headline, *align(rows)]
    judged = [(one.value, one) for one in tried if one.value is not None]
    if judged:
        pick = min if lower else max
        best = pick(judged, key=lambda pair: pair[0])[1]  # the first one wins a tie
        search = ("hparams_search=", "objective=", "seed=")
        kept = [word for word in fixed if not word.startswith(search)]
        command = shlex.join([*kept, *overrides(best.params), "seed=0,1,2"])
        words.append(f"Best: trial {best.number}. With several seeds:")
        words.append(typed(f"  python train.py -m {command}"))
    elif tried:
        words.append(f"No trial has a finite {objective}, so there is no best one")
    return "\n".join(words)
