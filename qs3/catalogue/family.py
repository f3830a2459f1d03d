"""What a structural family of a class is, and the random choices of one object."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from qs3.meshes.mesh import Mesh

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


Build = Callable[[Draw], list[Mesh]]


@dataclass(frozen=True)
class Family:
    """Objects of one construction, e.g. chairs on a swivel base.

    Attributes:
        name: unique within its class.
        split: the only split that draws from it, unless a catalogue has `families="all"`.
        build: makes the parts of one object, front along -y.
    """

    name: str
    split: str
    build: Build


def families_of(train: tuple[Build, ...], test: tuple[Build, ...]) -> tuple[Family, ...]:
    """The families of a class, named after their functions."""
    split = [("train", build) for build in train] + [("test", build) for build in test]
    return tuple(Family(build.__name__, where, build) for where, build in split)
