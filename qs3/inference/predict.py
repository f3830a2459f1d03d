"""`qs3 predict`: clouds predicted in batches by several threads, and what is printed about them."""

from __future__ import annotations

import contextlib
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import torch

from qs3.datasets.pointed import LEVEL, PLANES
from qs3.errors import ConfigError, DataError
from qs3.evaluation.expected import expected_accuracy
from qs3.evaluation.ood import other_units
from qs3.inference.inputs import Sample, Unit, reason_of
from qs3.inference.model_file import find_result
from qs3.inference.predictor import DIVERGED, Predictor, Prepared, load
from qs3.inference.scores import Count, disputed, right, scores
from qs3.inference.table import Row
from qs3.kernels.norms import use_trained
from qs3.runs.metrics import read_metrics

_SHOWN = 10  # failures in the text for the terminal


def predict_units(
    predictor: Predictor,
    units: Iterable[Unit],
    floor: float | None = None,
    second: Predictor | None = None,
    batch_size: int = 16,
    threads: int = 1,
    advance: Callable[[], None] = lambda: None,
) -> Iterator[tuple[Row, Sample | None]]:
    """A row for each cloud, in order, and what it was made of; `advance` is called after a unit.

    Each thread has a batch of its own: the work between products of matrices does not gain from
    several threads in one batch. A few batches are in memory.
    """
    threads_before = torch.get_num_threads()
    pool = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))
    running: deque[Future[list[tuple[Row, Sample | None]]]] = deque()
    try:
        # Once for all: threads that change and restore a net's domain would do it to one another.
        with contextlib.ExitStack() as using:
            for one in filter(None, (predictor, second)):
                using.enter_context(use_trained(one.net, "target"))
            for batch in _batches(units, batch_size, advance):
                running.append(pool.submit(_predicted, predictor, second, batch, floor))
                if len(running) > 2 * threads:
                    yield from running.popleft().result()
            while running:
                yield from running.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads_before)  # libraries below torch keep one number for all


def _batches(
    units: Iterable[Unit], size: int, advance: Callable[[], None]
) -> Iterator[list[Row | Sample]]:
    """The clouds of all units, `size` at a time; what cannot be read is a row already."""
    batch: list[Row | Sample] = []
    for unit in units:
        for item in unit.read():
            batch.append(item)
            if len(batch) == size:
                yield batch
                batch = []
        advance()
    if batch:
        yield batch


def _predicted(
    predictor: Predictor,
    second: Predictor | None,
    batch: Sequence[Row | Sample],
    floor: float | None,
) -> list[tuple[Row, Sample | None]]:
    """The rows of a batch: each cloud prepared, and one pass of each net."""
    rows: list[tuple[Row, Sample | None]] = []
    ready: list[tuple[int, Sample, Prepared]] = []
    for i, item in enumerate(batch):
        if isinstance(item, Row):
            rows.append((item, None))
            continue
        try:
            ready.append((i, item, predictor.prepare(item.cloud, item.name, item.axis, floor)))
            rows.append((item.row("", None), None))
        except DataError as error:
            rows.append((item.row(reason_of(error, item.name), None), None))
    if not ready:
        return rows
    points = torch.stack([each.points for _, _, each in ready])
    plain = predictor.without_prior(points, len(points))
    found = predictor.prior(plain) if predictor.prior else plain
    others = _second_classes(second, [item for _, item, _ in ready], floor)
    for (i, item, each), probabilities, raw, other in zip(ready, found, plain, others, strict=True):
        if np.isnan(raw).any():
            rows[i] = item.row(DIVERGED, None), None
        else:
            row = item.row("; ".join(each.strange), probabilities)
            rows[i] = row._replace(second=other, without_prior=raw), item
    return rows


def second_opinion(name: str, first: Predictor, floor: float | None, **how: Any) -> Predictor:
    """Another classifier of the same classes and frame; `how` as of `load`."""
    second = load(name, **how)
    same = sorted(second.classes) == sorted(first.classes)
    if not same or second.result.gravity != first.result.gravity:
        raise ConfigError(f"second={name} has other classes, or clouds in another frame")
    second.floor(floor)
    return second


def _second_classes(
    second: Predictor | None, items: Sequence[Sample], floor: float | None
) -> list[str]:
    """The classes that a second classifier names; "" without one, or if it has diverged."""
    if second is None:
        return [""] * len(items)
    clouds = [second.prepare(item.cloud, item.name, item.axis, floor).points for item in items]
    found = second.probabilities(torch.stack(clouds), len(clouds))
    return ["" if np.isnan(one).any() else second.classes[int(one.argmax())] for one in found]


def agreement(rows: Sequence[Row], classes: Sequence[str]) -> list[str]:
    """How often a second classifier agrees, and, with labels, what that was worth."""
    asked = [row for row in rows if row.second]
    if not asked:
        return []
    parts = []
    for words, differs in (("agrees on", False), ("differs on", True)):
        some = [row for row in asked if disputed(row, classes) is differs]
        judged = [r for row in some if (r := right(row, classes)) is not None]
        share = f" ({sum(judged) / len(judged):.0%} right)" if judged else ""
        parts.append(f"{words} {len(some)}{share}")
    return [f"a second classifier {', '.join(parts)} (column second); inspect disagreements"]


def expected(rows: Sequence[Row], predictor: Predictor) -> float | None:
    """The share of answers that is expected to be right, without a look at labels."""
    plain = [row.without_prior for row in rows if row.without_prior is not None]
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
    result = predictor.result
    found = [predictor.prior.words] if predictor.prior else []
    if predictor.in_metres and kind == "file":
        found.append("the classifier knows sizes: coordinates count as metres")
    if predictor.needs_floor and not floor_known:
        height = predictor.camera_height
        found.append(f"the camera counts as {height:g} m above the floor (camera_height=)")
    if result.gravity == "none" and kind != "depth image":
        found.append("the classifier knows clouds in the frame of their camera, not z up")
    return found


def summary(rows: Sequence[Row], classes: Sequence[str]) -> list[str]:
    """What was predicted, for the terminal."""
    good = [row for row in rows if row.probabilities is not None]
    failed = [row for row in rows if row.probabilities is None]
    lines = []
    if good:
        counts = Counter(classes[int(np.argmax(row.probabilities))] for row in good)  # type: ignore[arg-type]
        lines.append("predicted " + ", ".join(f"{name} {n}" for name, n in counts.most_common()))
        lines += _scored(rows, classes)
        strange, odd = sum(bool(row.reason) for row in good), sum(bool(r.cautions) for r in good)
        lines.append(f"{strange} out of range (column out_of_range), {odd} with a caution")
        lines += filter(None, [other_units(row.reason for row in good)])
    ups = Counter(row.up for row in rows)
    if ups[PLANES] or ups[LEVEL]:
        lines.append(
            f"up was fitted to the planes of the picture for {ups[PLANES]}, and taken from a level "
            f"camera for {ups[LEVEL]} (up=)"
        )
    if dropped := sum(row.dropped or 0 for row in good):
        lines.append(f"{dropped} points left out, without depth or stray (column dropped)")
    if failed:
        lines.append(f"{len(failed)} failed:")
        lines += [f"  {row.file}: {row.reason}" for row in failed[:_SHOWN]]
        lines += [f"  and {len(failed) - _SHOWN} more, see the table"] * (len(failed) > _SHOWN)
    return lines


def _scored(rows: Sequence[Row], classes: Sequence[str]) -> list[str]:
    """Right and wrong, if there are labels."""
    found = scores(rows, classes)
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
