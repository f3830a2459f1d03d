"""Time that processors worked for this process: on a busy machine it says what wall time does not.

A process that waits for a core takes wall time and no processor time. What is left of the others
are shared caches and clock rates, some tens of percent where they change wall time by a factor.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

_PROCESSES = Path("/proc")
_TICKS = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100


def processor_seconds() -> float:
    """User and system time of this process, its threads and its children, since it began.

    Children that have ended and were waited for count everywhere; those that are alive, such as the
    other processes of DDP and workers that load data, where the system lists them (Linux).
    """
    own = os.times()
    ended = own.children_user + own.children_system
    return own.user + own.system + ended + sum(map(_of_process, _children(os.getpid())))


@dataclass(frozen=True)
class Moment:
    """When something began, by two clocks.

    Attributes:
        wall: `time.time()`.
        cores: `processor_seconds()`.
    """

    wall: float
    cores: float


def _of_process(pid: int) -> float:
    """Seconds of another process and all below it; 0 if it has just ended."""
    try:
        # The second field is a name in brackets, which may hold spaces and brackets.
        fields = (_PROCESSES / str(pid) / "stat").read_text().rpartition(")")[2].split()
        # Of proc(5): utime, stime, cutime, cstime are fields 14 to 17, the state is field 3.
        ticks = sum(int(field) for field in fields[11:15])
    except (OSError, ValueError):
        return 0.0
    return ticks / _TICKS + sum(map(_of_process, _children(pid)))


def _children(pid: int) -> list[int]:
    """Processes that another one's threads have started and that are alive."""
    found: list[int] = []
    try:
        for thread in (_PROCESSES / str(pid) / "task").iterdir():
            found += map(int, (thread / "children").read_text().split())
    except (OSError, ValueError):  # it has ended, or the system does not tell
        pass
    return found
