"""`qs3 predict`: clouds predicted in batches by several threads, and what is printed about them."""

import contextlib
import itertools
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import torch

from qs3.datasets.pointed import LEVEL, PLANES
from qs3.errors import ConfigError, DataError
from qs3.evaluation.ood import other_units
from qs3.evaluation.unlabelled import expected_accuracy
from qs3.inference.inputs import Sample
from qs3.inference.model_file import find_result
from qs3.inference.predictor import Predictor, load
from qs3.inference.table import Count, disputed, scores
from qs3.kernels.norms import use_trained
from qs3.runs.metrics import read_metrics

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
        found = second.probabilities(torch.stack(ready), len(ready))
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


def expected(samples: Sequence[Sample], predictor: Predictor) -> float | None:
    """The share of answers that is expected to be right, without a look at labels."""
    plain = [one.without_prior for one in samples if one.without_prior is not None]
    return expected_accuracy(predictor.result.held_out, np.array(plain)) if plain else None


def trained_on(name: str) -> str:
    """What the data of the classifier's run are made of; "" where that is not known."""
    try:
        metrics = read_metrics(find_result(name).parent)
    except DataError:  # no prediction depends on it
        return ""
    return metrics.data_text if metrics else ""


def notes(predictor: Predictor, kind: str, floor_known: bool) -> list[str]:
    """What is taken for granted about the clouds, for terminal and page."""
    found = [predictor.prior.words] if predictor.prior else []
    if predictor.in_metres and kind == "file":
        found.append("the classifier knows sizes: coordinates count as metres")
    if predictor.needs_floor and not floor_known:
        height = predictor.camera_height
        found.append(f"the camera counts as {height:g} m above the floor (camera_height=)")
    if predictor.result.gravity == "none" and kind != "depth image":
        found.append("the classifier knows clouds in the frame of their camera, not z up")
    return found


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
        lines.append(f"{dropped} points left out, without depth or stray (column dropped)")
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

    def of(count: Count) -> str:
        return f"{count.right} of {count.of} ({count.share:.1%})"

    tiers = "".join(f"; {tier} {of(count)}" for tier, count in found.tiers.items())
    label, times = found.majority
    line = f"right {of(found.all)}, balanced {found.balanced:.1%}{tiers}"
    others = ", ".join(f"{name} {n}" for name, n in found.unknown.items())
    return [
        f"{line}; always {label}: {times / found.all.of:.1%}",
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
