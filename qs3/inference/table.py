"""The table of `qs3 predict`, a row for each object, and how many are right by their labels."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from qs3.inference.inputs import Sample
from qs3.utils.text_table import csv_text

COLUMNS = (
    *("file", "status", "class", "confidence", "second", "label", "points", "dropped", "tier"),
    *("caution", "up", "out_of_range", "reason"),
)
STRANGE = "unlike training"
"""The kind of what is out of the range of training's clouds."""

DISPUTED = "another classifier disagrees"
"""The kind of what a second classifier calls otherwise."""


def as_csv(samples: Sequence[Sample], classes: Sequence[str]) -> str:
    """A line each, with a column for each class."""
    lines: list[list[Any]] = [[*COLUMNS, *(f"p_{name}" for name in classes)]]
    for one in samples:
        status, sure, strange, each = "failed", None, "", [None] * len(classes)
        if one.probabilities is not None:
            status, sure, each = "ok", one.confidence, one.probabilities.tolist()
            strange = "yes" if one.reason else "no"
        cautions = "; ".join(caution.words for caution in one.cautions)
        row = [one.name, status, one.cls, sure, one.second, one.label, one.points, one.dropped]
        lines.append([*row, one.tier, cautions, one.up, strange, one.reason, *each])
    return csv_text(lines)


def right(one: Sample, classes: Sequence[str]) -> bool | None:
    """Whether the net is right; None if there is no prediction, or no label of its classes."""
    return one.cls == one.label if one.cls and one.label in classes else None


def disputed(one: Sample) -> bool:
    """Whether a second classifier was asked, and names another class."""
    return bool(one.cls and one.second) and one.cls != one.second


def kinds(one: Sample) -> list[str]:
    """What was wrong with a cloud, or with what is said of it, in a few words each."""
    strange = [STRANGE] * bool(one.cls and one.reason)
    return [*(caution.kind for caution in one.cautions), *strange, *[DISPUTED] * disputed(one)]


class Count(NamedTuple):
    """So many right of so many."""

    right: int
    of: int

    @property
    def share(self) -> float:
        """In [0, 1]; 0 of none."""
        return self.right / max(self.of, 1)


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of the samples with a prediction and a label that is one of the net's classes."""

    all: Count
    balanced: float  # mean over the classes that are there of the share that is right
    majority: tuple[str, int]  # the commonest label, and how many have it
    confidence: float  # mean over all of them
    tiers: dict[str, Count]
    kinds: dict[str, tuple[Count, Count]]  # by what was wrong with a cloud: with it, without it
    confusion: Int[np.ndarray, "c c"]  # how often each label (row) was called each class
    unknown: dict[str, int]  # labels that are not among the net's classes, and how often
    unlabelled: int


def scores(samples: Sequence[Sample], classes: Sequence[str]) -> Scores | None:
    """The figures; None if no sample has both a prediction and a label of the net's classes."""
    predicted = [one for one in samples if one.cls]
    judged = [one for one in predicted if one.label in classes]
    if not judged:
        return None

    def count(some: Iterable[Sample]) -> Count:
        values = [one.cls == one.label for one in some]
        return Count(sum(values), len(values))

    confusion = np.zeros((len(classes), len(classes)), dtype=np.int64)
    for one in judged:
        confusion[classes.index(one.label), classes.index(one.cls)] += 1
    totals = confusion.sum(axis=1)
    every = Counter(kind for one in judged for kind in {*kinds(one)})
    return Scores(
        count(judged),
        float((confusion.diagonal()[totals > 0] / totals[totals > 0]).mean()),
        Counter(one.label for one in judged).most_common(1)[0],
        float(np.mean([one.confidence for one in judged])),
        {
            tier: count(one for one in judged if one.tier == tier)
            for tier in sorted({one.tier for one in judged} - {""})
        },
        {
            kind: (
                count(one for one in judged if kind in kinds(one)),
                count(one for one in judged if kind not in kinds(one)),
            )
            for kind, _ in every.most_common()
        },
        confusion,
        dict(Counter(one.label for one in predicted if one.label and one.label not in classes)),
        sum(not one.label for one in predicted),
    )
