"""Clouds read, prepared and predicted in batches, by several threads."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import torch

from qs3.errors import DataError
from qs3.inference.inputs import (
    Sample,
    Unit,
    reason_of,
)
from qs3.inference.predictor import DIVERGED, Predictor, Prepared
from qs3.inference.settings import Settings
from qs3.inference.table import Row
from qs3.kernels.norms import use_trained


def predict_units(
    predictor: Predictor,
    units: Iterable[Unit],
    settings: Settings,
    advance: Callable[[], None] = lambda: None,
    second: Predictor | None = None,
) -> Iterator[tuple[Row, Sample | None]]:
    """A row for each cloud, in order, and what it was made of; `advance` is called after a unit.

    `second` is asked for its opinion of each cloud, too.

    Each of `settings.threads` threads has a batch of its own: the work between products of
    matrices does not gain from several threads in one batch. A few batches are in memory.
    """
    threads_before = torch.get_num_threads()
    pool = ThreadPoolExecutor(settings.threads, initializer=torch.set_num_threads, initargs=(1,))
    running: deque[Future[list[tuple[Row, Sample | None]]]] = deque()
    nets = [one.net for one in (predictor, second) if one]
    nets += [predictor.before_target] if predictor.before_target else []
    floor = settings.floor if settings.camera_height is None else -settings.camera_height
    try:
        # Once for all: threads that change and restore a net's domain would do it to one another.
        with contextlib.ExitStack() as using:
            for net in nets:
                using.enter_context(use_trained(net, "target"))
            for batch in _batches(units, settings.batch_size, advance):
                running.append(pool.submit(_judged, predictor, second, batch, floor))
                if len(running) > 2 * settings.threads:
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
        for item in unit():
            batch.append(item)
            if len(batch) == size:
                yield batch
                batch = []
        advance()
    if batch:
        yield batch


def _judged(
    predictor: Predictor,
    second: Predictor | None,
    batch: Sequence[Row | Sample],
    floor: float | None,
) -> list[tuple[Row, Sample | None]]:
    """The rows of a batch: each cloud prepared, and one pass of each net."""
    prepared: dict[int, tuple[Sample, Prepared]] = {}
    rows: dict[int, tuple[Row, Sample | None]] = {}
    for i, item in enumerate(batch):
        if isinstance(item, Row):
            rows[i] = item, None
            continue
        try:
            prepared[i] = item, predictor.prepare(item.cloud, item.name, item.axis, floor)
        except DataError as error:
            rows[i] = item.row(reason_of(error, item.name), None), None
    if prepared:
        points = torch.stack([each.points for _, each in prepared.values()])
        plain = predictor.without_prior(points, len(points))
        found = predictor.prior(plain) if predictor.prior else plain
        asked = predictor.asked(points, len(points)) if predictor.before_target else plain
        others = _said(second, [item for item, _ in prepared.values()], floor)
        for (i, (item, each)), probabilities, judged, other in zip(
            prepared.items(), found, asked, others, strict=True
        ):
            if np.isnan(probabilities).any():
                rows[i] = item.row(DIVERGED, None), None
                continue
            row = item.row("; ".join(each.strange), probabilities)
            rows[i] = row._replace(second=other, measures=each.measures, asked=judged), item
    return [rows[i] for i in range(len(batch))]


def _said(second: Predictor | None, items: Sequence[Sample], floor: float | None) -> list[str]:
    """The classes that a second classifier names; "" if there is none, or it has diverged."""
    if second is None:
        return [""] * len(items)
    clouds = [second.prepare(item.cloud, item.name, item.axis, floor).points for item in items]
    found = second.probabilities(torch.stack(clouds), len(clouds))
    return ["" if np.isnan(one).any() else second.classes[int(one.argmax())] for one in found]
