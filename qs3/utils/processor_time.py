"""Time that processors worked for this process, which a busy machine does not change."""

from __future__ import annotations

import os
from dataclasses import dataclass


def processor_seconds() -> float:
    """User and system time of this process, its threads and its ended children, in seconds."""
    own = os.times()
    return own.user + own.system + own.children_user + own.children_system


@dataclass(frozen=True)
class Moment:
    """When something began, by two clocks.

    Attributes:
        wall: `time.time()`.
        cores: `processor_seconds()`.
    """

    wall: float
    cores: float
