"""How far a loop is: a bar on a terminal, a line now and then in a log."""

import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

log = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 10.0


@contextmanager
def progress_bar(label: str, *, total: int, done: int = 0) -> Iterator[Callable[[], None]]:
    """Show how far a loop is, with the time left; gives a function to call after each step.

    Of `total` steps an earlier run has `done` some.
    """
    if sys.stderr.isatty():
        from rich import progress
        from rich.console import Console

        with progress.Progress(
            progress.TextColumn("{task.description}"),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TimeElapsedColumn(),
            progress.TextColumn("left"),
            progress.TimeRemainingColumn(),
            console=Console(stderr=True),
            # What goes to a file or a pipe stays what it is; on a terminal it goes above the bar.
            redirect_stdout=sys.stdout.isatty(),
        ) as bar:
            task = bar.add_task(label, total=total, completed=done)
            yield lambda: bar.advance(task)
        return

    start = last = time.monotonic()
    steps = done

    def log_line() -> None:
        nonlocal steps, last
        steps += 1
        now = time.monotonic()
        if now - last >= SECONDS_BETWEEN_LINES or steps >= total:
            last = now
            each = (now - start) / (steps - done)
            left = (total - steps) * each
            log.info("%s: %d of %d, %.3g s each, %.0f s left", label, steps, total, each, left)

    yield log_line


def shown(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """Iterate with a bar on a terminal that goes away at the end; silent elsewhere.

    `total` says how many there are, if `items` has no length.
    """
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    quiet = not console.is_terminal
    yield from track(items, label, total, console=console, transient=True, disable=quiet)
