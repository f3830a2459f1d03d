"""A run's clouds for the page where they can be turned: what it got wrong first."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from qs3.errors import MissingDataError
from qs3.report.figures.canvas import NothingToDrawError
from qs3.report.inspection.open_dataset import opened_domain
from qs3.report.inspection.viewed import part_of
from qs3.report.runs.data import RunFiles
from qs3.report.runs.domains import domain_of, open_domain, positions_in
from qs3.report.viewer.page import Part
from qs3.runs.predictions import Predictions
from qs3.utils.plural import counted


def worst_first(run: RunFiles, match: str = "") -> list[int]:
    """Positions in the run's predictions of ids that hold `match`.

    First the errors, the most confident before the others; then all else, the least confident
    first.

    Raises:
        MissingDataError: there are no predictions.
    """
    said = _said(run)
    there = np.array([match in id_ for id_ in said.ids])
    wrong = (said.labels >= 0) & (said.predicted != said.labels)
    sure = said.probabilities.max(axis=1)
    order = np.lexsort((np.where(wrong, -sure, sure), ~wrong))
    return [int(i) for i in order if there[i]]


def part_of_run(
    run: RunFiles,
    positions: Sequence[int],
    data_dir: str | Path | None = None,
    *,
    residuals: bool = True,
    advance: Callable[[], None] = lambda: None,
) -> Part:
    """Clouds of the run's target with its result's predictions.

    Args:
        run: finished.
        positions: in its predictions.
        data_dir: where the datasets lie; None: where the run's config says.
        residuals, advance: as `part_of`.

    Raises:
        MissingDataError: the run's target is not there, or there are no predictions.
        DataError: it is damaged.
    """
    said = _said(run)
    try:
        domain = domain_of(run, "target", data_dir)
        data = open_domain(run, "target", data_dir)
    except NothingToDrawError as error:
        raise MissingDataError(f"{run.folder}: {error}") from error
    opened = opened_domain(domain, data)
    rows = positions_in(data, run, [said.ids[i] for i in positions])
    part = part_of(opened, rows, residuals=residuals, advance=advance)
    sure = said.probabilities.max(axis=1)
    shown = [
        dataclasses.replace(
            one,
            label="" if said.labels[i] < 0 else said.classes[said.labels[i]],
            called=said.classes[said.predicted[i]],
            sure=float(sure[i]) if np.isfinite(sure[i]) else None,  # JSON knows no NaN
        )
        for one, i in zip(part.shown, positions, strict=True)
    ]
    return dataclasses.replace(part, shown=shown, about=_about(run, said, len(shown)))


def _said(run: RunFiles) -> Predictions:
    if run.predictions is None:
        why = "it is a run that did not finish; repeat its command"
        if run.metrics is not None:
            why = "its predictions.csv is gone; repeat its command with force=true"
        raise MissingDataError(f"{run.folder} has no predictions: {why}")
    return run.predictions


def _about(run: RunFiles, said: Predictions, count: int) -> str:
    labelled = said.labels >= 0
    wrong = int((labelled & (said.predicted != said.labels)).sum())
    order = "in doubt first"
    if labelled.any():
        order = counted(wrong, "is wrong", "are wrong, the most confident first")
    text = f"{run.title}, target {run.target}: {count} of {len(said.ids)} clouds; {order}"
    m = run.metrics
    if m is None:
        return text
    trained = f"{m.source} ({m.made_of.source})" if m.source != m.target else "it"
    return f"{text}; the target is made of: {m.made_of.target}; trained on {trained}"
