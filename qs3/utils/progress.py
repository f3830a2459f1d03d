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
    start = last = time.monotonic()
    steps = done

    def rate() -> float:
        return (steps - done) / max(time.monotonic() - start, 1e-9)

    def log_line() -> None:
        nonlocal steps, last
        steps += 1
        if time.monotonic() - last >= SECONDS_BETWEEN_LINES or steps >= total:
            last = time.monotonic()
            left = (total - steps) / rate()
            line = "%s: %d of %d, %s, %.0f s left"
            log.info(line, label, steps, total, _speed(rate()), left)

    if not sys.stderr.isatty():
        yield log_line
        return
    with terminal_bar("{task.fields[rate]}") as bar:
        task = bar.add_task(label, total=total, completed=done, rate="")

        def advance() -> None:
            nonlocal steps
            steps += 1
            bar.update(task, advance=1, rate=_speed(rate()))

        yield advance


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
    from rich import progress
    from rich.console import Console

    return progress.Progress(
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        *map(progress.TextColumn, fields),
        progress.TimeElapsedColumn(),
        progress.TextColumn("left"),
        progress.TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=transient,
        # What goes to a file or a pipe stays what it is; on a terminal it goes above the bar.
        redirect_stdout=sys.stdout.isatty(),
    )


def _speed(rate: float) -> str:
    return f"{rate:.1f}/s" if rate >= 1 else f"{1 / rate:.1f} s each"
