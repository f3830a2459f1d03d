"""glibc's allocator as training wants it: what a step frees is kept for the next step."""

from __future__ import annotations

import ctypes
import sys

# malloc.h
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4


def keep_freed_memory() -> bool:
    """Do not hand freed memory back to the system; whether that could be asked for.

    By default each tensor of more than 32 MB, and some below, is mapped anew and unmapped when it
    is freed: the kernel clears its pages at their first use, some 25,000 a step of DGCNN with 16
    clouds of 512 points, and here a few hundred. The process stays as large as it was at most.
    Not where another allocator was loaded before, and not without glibc.
    """
    if sys.platform != "linux":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    settings = ((_M_MMAP_MAX, 0), (_M_TRIM_THRESHOLD, 2**31 - 1), (_M_TOP_PAD, 64 << 20))
    return all([bool(mallopt(key, value)) for key, value in settings])
