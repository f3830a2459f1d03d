"""How many threads this process takes, and how they wait for one another.

OpenMP's threads (torch's) wait for the slowest of them in a loop that keeps the processor, because
waking a sleeper takes some microseconds. Where another process has the core that the slowest one
needs, they spin away the time in which it could run: a step of DGCNN with two threads beside one
busy process a core took 5 to 12 times as long as alone, and 1 to 3 times where threads sleep;
alone, a step is up to a quarter longer.
"""

from __future__ import annotations

import os
import sys
from typing import Literal

WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")


def let_waiting_threads_sleep() -> None:
    """Have OpenMP's threads sleep where they wait, unless the environment says something of it.

    For the beginning of a command: OpenMP reads the environment when torch is loaded. Processes
    that this one starts inherit it.
    """
    if "torch" not in sys.modules and not any(name in os.environ for name in WAITING):
        os.environ["OMP_WAIT_POLICY"] = "passive"


def cores() -> list[int]:
    """Numbers of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def free_cores() -> int:
    """How many of these are free by the load of the last minute, rounded; at least 1."""
    return max(1, round(len(cores()) - os.getloadavg()[0]))


def number_of(threads: int | Literal["auto"] | None) -> int:
    """`trainer.threads` as a number: null is all cores, "auto" those that are free now."""
    if threads is None:
        return len(cores())
    return free_cores() if threads == "auto" else threads
