"""Right and wrong among predictions whose labels somebody gave, and what goes with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from qs3.inference.table import Row

STRANGE = "unlike training"
"""The kind of what is out of the range of training's clouds."""

DISPUTED = "another classifier disagrees"
"""The kind of what a second classifier calls otherwise."""


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
    """Scores of the rows with a prediction and a label that is one of the net's classes.

    Attributes:
        all: right ones.
        balanced: mean over the classes that are there of the share that is right, in [0, 1].
        majority: the commonest label, and how many have it.
        confidence: mean over all of them, in [0, 1].
        tiers: right ones of each tier, if there are any.
        kinds: by what was wrong with a cloud: right ones with it, and without it.
        confusion: [C, C] how often each label (row) was called each class (column).
        unknown: labels that are not among the net's classes, and how often.
        unlabelled: rows with a prediction and no label.
    """

    all: Count
    balanced: float
    majority: tuple[str, int]
    confidence: float
    tiers: dict[str, Count]
    kinds: dict[str, tuple[Count, Count]]
    confusion: Int[np.ndarray, "c c"]
    unknown: dict[str, int]
    unlabelled: int


def right(row: Row, classes: Sequence[str]) -> bool | None:
    """Whether the net is right; None if there is no prediction, or no label of its classes."""
    if row.probabilities is None or row.label not in classes:
        return None
    return classes[int(row.probabilities.argmax())] == row.label


def disputed(row: Row, classes: Sequence[str]) -> bool:
    """Whether a second classifier was asked, and names another class."""
    if row.probabilities is None or not row.second:
        return False
    return classes[int(row.probabilities.argmax())] != row.second


def kinds(row: Row, classes: Sequence[str]) -> list[str]:
    """What was wrong with a cloud, or with what is said of it, in a few words each."""
    found = [caution.kind for caution in row.cautions]
    found += [STRANGE] * bool(row.probabilities is not None and row.reason)
    return found + [DISPUTED] * disputed(row, classes)


def scores(rows: Iterable[Row], classes: Sequence[str]) -> Scores | None:
    """The figures; None if no row has both a prediction and a label of the net's classes."""
    said = [row for row in rows if row.probabilities is not None]
    judged = [(row, r) for row in said if (r := right(row, classes)) is not None]
    if not judged:
        return None
    confusion = np.zeros((len(classes), len(classes)), dtype=np.int64)
    for row, _ in judged:
        assert row.probabilities is not None
        confusion[classes.index(row.label), int(row.probabilities.argmax())] += 1
    there = confusion.sum(axis=1) > 0
    recalls = confusion.diagonal()[there] / confusion.sum(axis=1)[there]
    (label, times), *_ = Counter(row.label for row, _ in judged).most_common(1)
    tiers = sorted({row.tier for row, _ in judged} - {""})
    every = Counter(kind for row, _ in judged for kind in {*kinds(row, classes)})
    return Scores(
        _count(r for _, r in judged),
        float(recalls.mean()),
        (label, times),
        float(np.mean([np.max(row.probabilities) for row, _ in judged])),  # type: ignore[arg-type]
        {tier: _count(r for row, r in judged if row.tier == tier) for tier in tiers},
        {
            kind: (
                _count(r for row, r in judged if kind in kinds(row, classes)),
                _count(r for row, r in judged if kind not in kinds(row, classes)),
            )
            for kind, _ in every.most_common()
        },
        confusion,
        dict(Counter(row.label for row in said if row.label and row.label not in classes)),
        sum(not row.label for row in said),
    )


def _count(found: Iterable[bool]) -> Count:
    values = list(found)
    return Count(sum(values), len(values))
