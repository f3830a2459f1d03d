"""What a structural family of a class is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from qs3.meshes.catalogue.draw import Draw
from qs3.meshes.mesh import Mesh


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
    build: Callable[[Draw], list[Mesh]]


def train(build: Callable[[Draw], list[Mesh]]) -> Family:
    """A family of the training split, named after its function."""
    return Family(build.__name__, "train", build)


def test(build: Callable[[Draw], list[Mesh]]) -> Family:
    """A family of the test split, named after its function."""
    return Family(build.__name__, "test", build)
