"""`qs3 predict`: clouds predicted in batches by several threads, their table and their scores."""

import contextlib
import itertools
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Int

from qs3.datasets.pointed import LEVEL, PLANES
from qs3.errors import ConfigError
from qs3.evaluation.ood import other_units
from qs3.inference.inputs import Sample
from qs3.inference.predictor import Predictor, load
from qs3.kernels.norms import use_trained
from qs3.utils.text_table import csv_text

COLUMNS = (
    *("file", "status", "class", "confidence", "second", "label", "points", "dropped", "tier"),
    *("caution", "up", "out_of_range", "reason"),
)
STRANGE = "unlike training"
"""The kind of what is out of the range of training's clouds."""

DISPUTED = "another classifier disagrees"
"""The kind of what a second classifier calls otherwise."""

_SHOWN = 10  # failures in the text for the terminal

Unit = Callable[[], Iterator[Sample]]


def predict_units(
    predictor: Predictor,
    units: Iterable[Unit],
    floor: float | None = None,
    second: Predictor | None = None,
    batch_size: int = 16,
    threads: int = 1,
    advance: Callable[[], None] = lambda: None,
) -> Iterator[Sample]:
    """The objects of all units, in order, predicted; `advance` is called after a unit.

    Each thread has a batch of its own: the work between products of matrices does not gain from
    several threads in one batch. A few batches are in memory.
    """
    threads_before = torch.get_num_threads()
    pool = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))
    running: deque[Future[list[Sample]]] = deque()
    try:
        # Once for all: threads that change and restore a net's domain would do it to one another.
        with contextlib.ExitStack() as using:
            for one in filter(None, (predictor, second)):
                using.enter_context(use_trained(one.net, "target"))
            objects = _objects(units, advance)
            while batch := list(itertools.islice(objects, batch_size)):
                running.append(pool.submit(_predicted, predictor, second, batch, floor))
                if len(running) > 2 * threads:
                    yield from running.popleft().result()
            while running:
                yield from running.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads_before)  # libraries below torch keep one number for all


def _objects(units: Iterable[Unit], advance: Callable[[], None]) -> Iterator[Sample]:
    for unit in units:
        yield from unit()
        advance()


def _predicted(
    predictor: Predictor, second: Predictor | None, batch: list[Sample], floor: float | None
) -> list[Sample]:
    predictor.predict(batch, floor)
    good = [one for one in batch if one.cls]
    if second and good:
        ready = [second.prepare(one.cloud, one.name, one.axis, floor).points for one in good]
        found = second.probabilities(torch.stack(ready), len(ready), floor)
        for one, each in zip(good, found, strict=True):
            one.second = "" if np.isnan(each).any() else second.classes[int(each.argmax())]
    return batch


def second_opinion(name: str, first: Predictor, floor: float | None, **how: Any) -> Predictor:
    """Another classifier of the same classes and frame; `how` as of `load`."""
    second = load(name, **how)
    same = sorted(second.classes) == sorted(first.classes)
    if not same or second.result.gravity != first.result.gravity:
        raise ConfigError(f"second={name} has other classes, or clouds in another frame")
    second.floor(floor)
    return second


def notes(predictor: Predictor, kind: str, floor_known: bool) -> list[str]:
    """What is taken for granted about the clouds, for terminal and page."""
    found = [predictor.prior.words] if predictor.prior else []
    if predictor.in_metres and kind == "file":
        found.append("the classifier knows sizes: coordinates count as metres")
    if predictor.needs_floor and not floor_known:
        height = f"{predictor.camera_height:g} m above the floor, as in training"
        found.append(f"the camera counts as {height} (camera_height=)")
    if predictor.result.gravity == "none" and kind != "depth image":
        found.append("the classifier knows clouds in the frame of their camera, not z up")
    return found


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
    """Whether the net is right; None without a prediction or a label of its classes."""
    return one.cls == one.label if one.cls and one.label in classes else None


def disputed(one: Sample) -> bool:
    """Whether a second classifier was asked, and names another class."""
    return bool(one.cls and one.second) and one.cls != one.second


def kinds(one: Sample) -> list[str]:
    """What was wrong with a cloud or its label, in a few words each."""
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


def summary(samples: Sequence[Sample], classes: Sequence[str]) -> list[str]:
    """What was predicted, for the terminal."""
    good = [one for one in samples if one.cls]
    failed = [one for one in samples if not one.cls]
    lines = []
    if good:
        counts = Counter(one.cls for one in good)
        lines.append("predicted " + ", ".join(f"{name} {n}" for name, n in counts.most_common()))
        lines += _scored(samples, classes)
        strange, odd = sum(bool(one.reason) for one in good), sum(bool(o.cautions) for o in good)
        lines.append(f"{strange} out of range (column out_of_range), {odd} with a caution")
        lines += filter(None, [other_units(one.reason for one in good)])
    ups = Counter(one.up for one in samples)
    if ups[PLANES] or ups[LEVEL]:
        lines.append(
            f"up was fitted to the planes of the picture for {ups[PLANES]}, and taken from a level "
            f"camera for {ups[LEVEL]} (up=)"
        )
    if dropped := sum(one.dropped or 0 for one in good):
        lines.append(f"{dropped} points left out, without depth (column dropped)")
    if failed:
        lines.append(f"{len(failed)} failed:")
        lines += [f"  {one.name}: {one.reason}" for one in failed[:_SHOWN]]
        lines += [f"  and {len(failed) - _SHOWN} more, see the table"] * (len(failed) > _SHOWN)
    return lines + _agreement(good, classes)


def _scored(samples: Sequence[Sample], classes: Sequence[str]) -> list[str]:
    """Right and wrong, if there are labels."""
    found = scores(samples, classes)
    if found is None:
        return []

    label, times = found.majority
    line = f"right {found.all.right} of {found.all.of} ({found.all.share:.1%})"
    others = ", ".join(f"{name} {n}" for name, n in found.unknown.items())
    return [
        f"{line}, balanced {found.balanced:.1%}; always {label}: {times / found.all.of:.1%}",
        *([f"labels that are not classes, left out: {others}"] if others else []),
    ]


def _agreement(samples: Sequence[Sample], classes: Sequence[str]) -> list[str]:
    """How often a second classifier agrees, and, with labels, what that was worth."""
    both = [one for one in samples if one.second]
    parts = []
    for words, differs in (("agrees on", False), ("differs on", True)):
        some = [one for one in both if disputed(one) is differs]
        judged = [one.cls == one.label for one in some if one.label in classes]
        share = f" ({np.mean(judged):.0%} right)" if judged else ""
        parts.append(f"{words} {len(some)}{share}")
    line = f"a second classifier {', '.join(parts)} (column second); inspect disagreements"
    return [line] if both else []
