"""What a scan can leave besides its cloud: each point's provenance, and a look at the images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.sensors.base import DepthFrame

PROVENANCE = ("view", "u_px", "v_px", "residual_m", "incidence_deg")
"""Columns of the array "provenance": see `provenance_of`."""

NO_RESIDUAL_M = -99.0
NO_INCIDENCE_DEG = -1.0

_NOT_A_PHOTOGRAPH = ("right", "reference", "disparity", "clean", "lit", "seen")


@dataclass(frozen=True)
class Keep:
    """What is wanted besides the cloud. None of it changes a byte of the cloud.

    Attributes:
        provenance: add the array "provenance" to the cloud.
        views: folder for the images and depths of every view; None keeps none. The views are
            then scanned with `explain`, which costs renders.
        twins: which further clouds are made, of `qs3.generation.twins.TWINS`.
        previews: ids of the objects whose first view is kept in small, for the contact sheet.
    """

    provenance: bool = False
    views: Path | None = None
    twins: frozenset[str] = frozenset()
    previews: frozenset[str] = frozenset()


def provenance_of(frame: DepthFrame, depth_m: np.ndarray, view: int) -> np.ndarray:
    """Where each point of `frame.points(depth_m, ...)` comes from, in the same order.

    Args:
        frame: the view.
        depth_m: [h, w] its depth, maybe masked; pixels that are not finite are left out.
        view: its number among the object's views, from 0.

    Returns:
        [M, 5] float32, columns as in `PROVENANCE`: number of the view; pixel (u, v) of the
        sensor's camera; measured minus true depth; angle between the surface's normal and the
        ray, 0 to 90. Where no surface lies behind the pixel (the matcher's patch reached over
        an edge) the last two have no value and are -99 and -1.
    """
    rows, cols = np.nonzero(np.isfinite(depth_m))
    clean = frame.clean_m[rows, cols].astype(np.float64)
    hit = np.isfinite(clean)
    error = depth_m[rows, cols] - np.where(hit, clean, 0)
    cosine = np.clip(frame.cosine[rows, cols].astype(np.float64), 0, 1)
    columns = (
        np.full(len(rows), view),
        frame.left + cols * frame.step_px,
        frame.top + rows * frame.step_px,
        np.where(hit, error, NO_RESIDUAL_M),
        np.where(hit, np.rad2deg(np.arccos(cosine)), NO_INCIDENCE_DEG),
    )
    return np.stack(columns, axis=1).astype(np.float32)


def photograph(images: dict[str, np.ndarray]) -> np.ndarray | None:
    """[h, w] what the sensor's (left) camera saw, as grey values; None if it shows nothing."""
    for name, image in images.items():
        if name in _NOT_A_PHOTOGRAPH:
            continue
        flat = image[0] if image.ndim == 3 else image  # of a sequence, the first
        if flat.ndim == 2 and flat.dtype != bool:
            return flat
    return None


def preview_of(frame: DepthFrame) -> dict[str, np.ndarray]:
    """The pictures of a view that the contact sheet shows, by name: [h, w] each."""
    disparity = frame.images.get("disparity")
    if disparity is not None:  # as coarse as the depth: a preview is small
        disparity = disparity[:: frame.step_px, :: frame.step_px]
    found = {
        "infrared": photograph(frame.images),
        "disparity": disparity,
        "depth_m": frame.depth_m,
    }
    return {name: np.array(image) for name, image in found.items() if image is not None}
