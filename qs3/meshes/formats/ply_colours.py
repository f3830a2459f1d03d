"""Colours of PLY's faces and vertices, as materials: sRGB, in whole numbers or in 0..1."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.finishes import Finish, FoundFinishes, linear

_CHANNELS = ("red", "green", "blue")
_LEVELS = 32
"""Steps of brightness that faces are sorted into: each is a material."""


def colours_of(columns: dict[str, Any], kinds: Mapping[str, np.dtype]) -> np.ndarray | None:
    """[N, 3] linear RGB of an element's rows; None where it has no colours.

    Args:
        columns: by name; of text all are floats.
        kinds: by name as the header says. Whole numbers of one or two bytes fill their type; wider
            ones, and floats above 1, are bytes by another name.
    """
    found = [columns[name] for name in _CHANNELS if isinstance(columns.get(name), np.ndarray)]
    if len(found) < len(_CHANNELS):
        return None
    colours = np.stack(found, axis=1)
    if not np.isfinite(colours).all():
        raise MeshError("has a colour that is not finite")
    return linear(colours / _most(colours, np.result_type(*(kinds[name] for name in _CHANNELS))))


def _most(colours: np.ndarray, kind: np.dtype) -> float:
    """What full brightness is."""
    if kind.kind == "f":
        return 255.0 if (colours > 1).any() else 1.0
    if kind.itemsize <= 2:
        return float(np.iinfo(kind).max)
    return next((most for most in (255.0, 65535.0) if (colours <= most).all()), np.iinfo(kind).max)


def add_colours(
    found: FoundFinishes,
    faces: np.ndarray,
    of_faces: np.ndarray | None,
    of_vertices: np.ndarray | None,
) -> None:
    """A matt grey for each face [F, 3] that is as bright as its colour's brightest channel."""
    colours = of_faces
    if colours is None and of_vertices is not None:
        if not 0 <= faces.min(initial=0) <= faces.max(initial=0) < len(of_vertices):
            return  # the caller says it of the faces
        colours = of_vertices[faces].mean(axis=1)
    if colours is None:
        return
    level = np.rint(colours.max(axis=1, initial=0) * _LEVELS).astype(np.int64)
    greys = [i / _LEVELS for i in range(_LEVELS + 1)]
    used, of_face = np.unique(level, return_inverse=True)
    found.add_each(of_face, [Finish((greys[i],) * 3, roughness=1.0) for i in used])
