"""What this process takes of the machine: threads, how they wait, memory, time, compiled loops.

OpenMP's threads (torch's) wait for the slowest of them in a loop that keeps the processor, because
waking a sleeper takes some microseconds. Where another process has the core that the slowest one
needs, they spin away the time in which it could run: a step of DGCNN with two threads next to one
busy process a core took 5 to 12 times as long as alone, and 1 to 3 times where threads sleep;
alone, a step is up to a quarter longer.
"""

import os
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")

# malloc.h
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4


def let_waiting_threads_sleep() -> None:
    """Have OpenMP's threads sleep where they wait, unless the environment sets it.

    For the beginning of a command: OpenMP reads the environment when torch is loaded. Processes
    that this one starts inherit it.
    """
    if "torch" not in sys.modules and not any(name in os.environ for name in WAITING):
        os.environ["OMP_WAIT_POLICY"] = "passive"


def cores() -> list[int]:
    """Numbers of the cores that this process may use."""
    return sorted(os.sched_getaffinity(0))


def free_cores() -> int:
    """How many of these are free by the load of the last minute, rounded; at least 1."""
    return max(1, round(len(cores()) - os.getloadavg()[0]))


class Moment(NamedTuple):
    """When something began: `time.time()`, and `processor_seconds()`."""

    wall: float
    cores: float


def processor_seconds() -> float:
    """User and system time of this process, its threads and its ended children, in seconds."""
    return sum(os.times()[:4])


def keep_freed_memory() -> bool:
    """Do not hand freed memory back to the system; whether glibc's allocator took that.

    By default each tensor of more than 32 MB, and some below, is mapped anew and unmapped when it
    is freed: the kernel clears its pages at their first use, some 25,000 a step of DGCNN with 16
    clouds of 512 points, and here a few hundred. The process stays as large as it was at most.
    """
    import ctypes

    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is None:
        return False
    settings = ((_M_MMAP_MAX, 0), (_M_TRIM_THRESHOLD, 2**31 - 1), (_M_TOP_PAD, 64 << 20))
    return all([bool(mallopt(key, value)) for key, value in settings])


def compiled(kernel: Callable[..., Any]) -> Any:
    """`kernel`, compiled at the first call for each type.

    What was compiled is kept next to the kernel's file, or in the user's cache.
    """
    import numba

    settings: dict[str, Any] = {"nogil": True, "boundscheck": False, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **settings)(kernel)
    except RuntimeError:  # neither folder can be written
        return numba.njit(**settings)(kernel)
