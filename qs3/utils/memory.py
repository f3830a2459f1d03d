"""How much memory reading one file may take: one limit for all readers, asked before they take it.

A file is not trusted: a few bytes can promise gigabytes. `QS3_MEMORY_GB` in the environment moves
the limit, for files that are known to be large. Beside it, how much this process has had at most.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from pathlib import Path

from qs3.errors import ConfigError, DataError

VARIABLE = "QS3_MEMORY_GB"
DEFAULT_GB = 2.0


def memory_limit() -> int:
    """Bytes that reading one file may take.

    Raises:
        ConfigError: the variable is not a positive number.
    """
    words = os.environ.get(VARIABLE, "")
    try:
        limit = float(words) if words else DEFAULT_GB
    except ValueError:
        limit = math.nan
    if not 0 < limit < math.inf:
        raise ConfigError(f"{VARIABLE}={words}: expected gigabytes, a number above 0")
    return int(limit * 1e9)


def check_memory(needed: float, where: object, kind: type[DataError] = DataError) -> None:
    """Refuse what takes too much.

    Args:
        needed: bytes at the peak, as far as it is known before reading.
        where: begins the message: the file, and what in it; "" where it is added later.
        kind: of the error.

    Raises:
        DataError: of `kind`.
    """
    if needed > (limit := memory_limit()):
        raise kind(
            f"{where} takes {needed / 1e9:.3g} GB of memory, more than {limit / 1e9:.3g} GB: "
            f"refused; if it is to be trusted, set {VARIABLE}={math.ceil(needed / 1e9)}".lstrip()
        )


JSON_PEAK = 25
"""Peak memory over a text's size when its values are lists and dicts: "[[],[]," is the worst."""

TABLE_PEAK = 20
"""Likewise of cells of two letters in lists."""


YAML_PEAK = 5
"""Likewise of what `qs3.utils.yamls` reads, which counts the values."""


def read_whole(path: Path, peak: float) -> bytes:
    """A file's bytes, if `peak` times their number is within the limit.

    Raises:
        DataError: it is not.
        OSError: the file cannot be read.
    """
    check_memory(peak * path.stat().st_size, path)
    return path.read_bytes()


_PROCESS = Path("/proc/self")


def forget_peak() -> None:
    """Begin anew with what `peak_bytes` says, where the system can (Linux)."""
    with contextlib.suppress(OSError):
        (_PROCESS / "clear_refs").write_text("5")


def peak_bytes() -> int | None:
    """The most that this process has had in memory since `forget_peak`; None if nobody knows."""
    try:
        found = re.search(r"^VmHWM:\s*(\d+) kB$", (_PROCESS / "status").read_text(), re.MULTILINE)
    except OSError:
        return None
    return None if found is None else 1024 * int(found[1])
