"""How far a loop is: a bar on a terminal, a line now and then in a log."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress

T = TypeVar("T")

log = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 10.0


@contextmanager
def progress_bar(label: str, *, total: int, done: int = 0) -> Iterator[Callable[[], None]]:
    """Show how far a loop is, with rate and time left; gives a function to call after each step.

    Of `total` steps an earlier run has `done` some.
    """
    if sys.stderr.isatty():
        with _rich_bar(label, total, done) as advance:
            yield advance
    else:
        yield _LogLines(label, total, done).advance


def shown(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """Iterate with a bar on a terminal that goes away at the end; silent elsewhere.

    `total` says how many there are, if `items` has no length.
    """
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    quiet = not console.is_terminal
    yield from track(items, label, total, console=console, transient=True, disable=quiet)


def terminal_bar(*fields: str, transient: bool = False) -> Progress:
    """A bar on stderr, to be started: description, bar, steps of all, `fields`, time gone and left.

    Fields are formats of rich: "epochs," or "{task.fields[rate]}". A transient bar goes away.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        *map(TextColumn, fields),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=transient,
        # What goes to a file or a pipe stays what it is; on a terminal it goes above the bar.
        redirect_stdout=sys.stdout.isatty(),
    )


@contextmanager
def _rich_bar(label: str, total: int, done: int) -> Iterator[Callable[[], None]]:
    start, steps = time.monotonic(), 0
    with terminal_bar("{task.fields[rate]}") as bar:
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
