"""How many threads this process takes, and how they wait for one another.

OpenMP's threads (torch's) wait for the slowest of them in a loop that keeps the processor, because
waking a sleeper takes some microseconds. Where another process has the core that the slowest one
needs, they spin away the time in which it could run: a step of DGCNN with two threads beside one
busy process a core took 5 to 12 times as long as alone, and 1 to 3 times where threads sleep;
alone, a step is up to a quarter longer (`tests/benchmarks/test_busy_machine.py`).
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Literal

WATCHED_S = 0.3
"""How long `free_cores` watches the cores."""

WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
_STAT = Path("/proc/stat")


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
    """How many of these nobody uses now, rounded; at least 1.

    Their idle time is watched for `WATCHED_S`; where the system does not tell it, the load of the
    last minute is taken off.
    """
    mine = cores()
    before, begin = _idle_s(mine), time.monotonic()
    if before is None:
        load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
        return max(1, round(len(mine) - load))
    time.sleep(WATCHED_S)
    after, seconds = _idle_s(mine), time.monotonic() - begin
    return min(len(mine), max(1, round(((after or before) - before) / seconds)))


def _idle_s(mine: list[int]) -> float | None:
    """Seconds that the cores have idled since the start of the system, together."""
    try:
        lines = _STAT.read_text().splitlines()
        fields = [line.split() for line in lines]
        wanted = {f"cpu{number}" for number in mine}
        idle = [
            int(values[4]) + int(values[5])
            for values in fields
            if values[:1] and values[0] in wanted
        ]
        return sum(idle) / os.sysconf("SC_CLK_TCK") if len(idle) == len(mine) else None
    except (OSError, ValueError, IndexError):
        return None


def number_of(threads: int | Literal["auto"] | None) -> int:
    """`trainer.threads` as a number: null is all cores, "auto" those that are free now."""
    if threads is None:
        return len(cores())
    return free_cores() if threads == "auto" else threads
