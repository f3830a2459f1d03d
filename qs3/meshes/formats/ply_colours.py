"""Colours of PLY's faces and vertices, as materials: sRGB, in whole numbers or in 0..1."""

from __future__ import annotations

from typing import Any

import numpy as np

from qs3.errors import MeshError
from qs3.meshes.finishes import Finish, FoundFinishes, linear

_CHANNELS = ("red", "green", "blue")
_LEVELS = 32
"""Steps of brightness that faces are sorted into: each is a material."""


def colours_of(columns: dict[str, Any]) -> np.ndarray | None:
    """[N, 3] linear RGB of an element's rows; None where it has no colours.

    Text does not keep whether numbers were bytes: where one is above 1, all are of 255.
    """
    found = [columns[name] for name in _CHANNELS if isinstance(columns.get(name), np.ndarray)]
    if len(found) < len(_CHANNELS):
        return None
    colours = np.stack(found, axis=1)
    if not np.isfinite(colours).all():
        raise MeshError("has a colour that is not finite")
    if colours.dtype.kind in "iu":
        most = float(np.iinfo(colours.dtype).max)
    else:
        most = 255.0 if (colours > 1).any() else 1.0
    return linear(colours / most)


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
