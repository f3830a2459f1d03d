"""Random choices of one object, from a text key alone."""

from __future__ import annotations

import hashlib
from typing import TypeVar

import numpy as np

T = TypeVar("T")


class Draw:
    """A stream of choices that depends on nothing but `key`.

    The key is hashed with SHA-256 (Python's own `hash` differs from process to process), so
    "0/chair/train/7" gives the same chair everywhere, however many objects are asked for.
    """

    def __init__(self, key: str) -> None:
        digest = hashlib.sha256(key.encode()).digest()
        self._rng = np.random.default_rng(int.from_bytes(digest, "little"))

    def between(self, low: float, high: float) -> float:
        """Uniform in [low, high)."""
        return float(self._rng.uniform(low, high))

    def count(self, low: int, high: int) -> int:
        """Uniform integer in [low, high], both included."""
        return int(self._rng.integers(low, high + 1))

    def chance(self, probability: float) -> bool:
        """True with the given probability."""
        return bool(self._rng.random() < probability)

    def pick(self, *options: T) -> T:
        """One of the options, all equally likely."""
        return options[int(self._rng.integers(len(options)))]
