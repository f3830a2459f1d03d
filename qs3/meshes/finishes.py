"""What a mesh file says its faces are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from qs3.errors import MeshError

MAX_FINISHES = 10_000
NONE = -1
"""Of a face of which a file says nothing."""


@dataclass(frozen=True)
class Finish:
    """One material of a file, of which nothing is guessed yet.

    Attributes:
        colour: visible, linear RGB in 0..1; a metal's reflectance.
        roughness, specular: of the principled model, 0..1.
        metal: nothing is scattered below the surface.
        clear: share of the light that passes through, 0..1.
    """

    colour: tuple[float, float, float]
    roughness: float = 0.5
    specular: float = 0.5
    metal: bool = False
    clear: float = 0.0


@dataclass(frozen=True, eq=False)
class Finishes:
    """The materials of a mesh's faces.

    Attributes:
        kinds: each once.
        of_face: [F] int32, index into `kinds`, or `NONE`.
        pictured: faces whose colour lies in a picture, which is not read: they have `NONE`.
    """

    kinds: tuple[Finish, ...]
    of_face: Int[np.ndarray, " f"]
    pictured: int = 0

    @property
    def missing(self) -> int:
        """Faces of which the file says nothing that is read."""
        return int((self.of_face == NONE).sum())

    @staticmethod
    def joined(parts: Sequence[tuple[Finishes | None, int]]) -> Finishes | None:
        """Those of several meshes put together, each with its number of faces."""
        if all(finishes is None for finishes, _ in parts):
            return None
        found = FoundFinishes()
        for finishes, faces in parts:
            if finishes is None:
                found.add(faces, None)
            else:
                found.add_each(finishes.of_face, finishes.kinds)
                found.pictured += finishes.pictured
        return found.of(sum(faces for _, faces in parts))


class FoundFinishes:
    """Gathers the materials of a file in the order of its faces, while it is read.

    Attributes:
        pictured: see `Finishes`.
        notes: what a reader left out, for `load_mesh` to say.
    """

    def __init__(self) -> None:
        self.pictured = 0
        self.notes: list[str] = []
        self._kinds: dict[Finish, int] = {}
        self._parts: list[np.ndarray] = [np.zeros(0, np.int32)]

    def add(self, faces: int, finish: Finish | None, pictured: bool = False) -> None:
        """The next so many faces; `pictured`: their colour lies in a picture."""
        self.pictured += faces * pictured
        index = NONE if finish is None or pictured else self._index(finish)
        self._parts.append(np.full(faces, index, np.int32))

    def add_each(self, of_face: np.ndarray, kinds: Sequence[Finish | None]) -> None:
        """The next faces, each by its index into `kinds`, or `NONE`."""
        index = [NONE if kind is None else self._index(kind) for kind in kinds]
        self._parts.append(np.array([*index, NONE], np.int32)[of_face])

    def of(self, faces: int) -> Finishes | None:
        """All of them; None if the file says nothing of any face.

        Raises:
            MeshError: these are not the materials of so many faces.
        """
        of_face = np.concatenate(self._parts)
        if not self._kinds and not self.pictured:
            return None
        if len(of_face) != faces:
            raise MeshError(f"has materials of {len(of_face)} faces, but {faces} faces")
        return Finishes(tuple(self._kinds), of_face, self.pictured)

    def _index(self, finish: Finish) -> int:
        index = self._kinds.setdefault(finish, len(self._kinds))
        if index >= MAX_FINISHES:
            raise MeshError(f"has more than {MAX_FINISHES} materials")
        return index


def linear(srgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values in 0..1 (IEC 61966-2-1)."""
    srgb = np.clip(srgb, 0, 1)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
