"""Progress of a generation: a bar in a terminal, a line now and then in a log."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

log = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 10.0


@contextmanager
def progress_bar(label: str, *, total: int, done: int = 0) -> Iterator[Callable[[], None]]:
    """Show how far a loop is, with rate and time left.

    Args:
        label: what is going on.
        total: steps in all.
        done: steps that an earlier run has done.

    Yields:
        A function to call after each step.
    """
    if sys.stderr.isatty():
        with _rich_bar(label, total, done) as advance:
            yield advance
    else:
        yield _LogLines(label, total, done).advance


@contextmanager
def _rich_bar(label: str, total: int, done: int) -> Iterator[Callable[[], None]]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    start, steps = time.monotonic(), 0
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(label, total=total, completed=done, rate="")

        def advance() -> None:
            nonlocal steps
            steps += 1
            rate = steps / max(time.monotonic() - start, 1e-9)
            bar.update(task, advance=1, rate=_speed(rate))

        yield advance


class _LogLines:
    """A line every few seconds, and one at the end."""

    def __init__(self, label: str, total: int, done: int) -> None:
        self.label, self.total, self.done = label, total, done
        self.first = done
        self.start = self.last = time.monotonic()

    def advance(self) -> None:
        self.done += 1
        now = time.monotonic()
        if now - self.last < SECONDS_BETWEEN_LINES and self.done < self.total:
            return
        self.last = now
        rate = (self.done - self.first) / max(now - self.start, 1e-9)
        left = (self.total - self.done) / rate if rate else float("nan")
        log.info(
            "%s: %d of %d, %s, %.0f s left", self.label, self.done, self.total, _speed(rate), left
        )


def _speed(rate: float) -> str:
    return f"{rate:.1f}/s" if rate >= 1 or rate == 0 else f"{1 / rate:.1f} s each"
