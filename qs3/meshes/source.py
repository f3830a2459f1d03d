"""Where meshes come from: the embedded catalogue or a user's folder, behind one form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from qs3.meshes.mesh import Mesh


@dataclass(frozen=True)
class MeshItem:
    """One object to scan.

    Attributes:
        id: unique in its source, e.g. "chair/train/chair_0007"; decides the object's seed.
        cls: class name.
        split: "train" or "test".
        load: makes or reads the mesh; raises MeshError with the reason. Picklable.
        origin: what the user would look for: a file name or a family of the catalogue.
        path: the file it is read from; None if it is made.
    """

    id: str
    cls: str
    split: str
    load: Callable[[], Mesh]
    origin: str
    path: Path | None = None
