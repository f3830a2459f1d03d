"""Small pictures as PNG: a cloud from slightly above, and an object in its depth image."""

from __future__ import annotations

import io

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from qs3.geometry.orthographic import project, unit
from qs3.utils.plotting import cloud_colours

SIDE_PX = 168
_PANEL = (247, 248, 250)
_OUTLINE = (181, 64, 58)
_MARGIN = 0.35  # of an object's larger side, shown around it
_DOT_PX = (2, 5)
_MOST_POINTS = 1024


def cloud_png(cloud: Float[np.ndarray, "n 3"]) -> bytes:
    """A cloud, z up, as `qs3 report pictures` shows it: colour is height, paler is farther."""
    cloud = cloud[:: max(1, len(cloud) // _MOST_POINTS)]
    picture = np.full((SIDE_PX, SIDE_PX, 3), _PANEL, dtype=np.uint8)
    seen, depth, height = project(cloud)
    size = int(np.clip(round(60 / np.sqrt(len(cloud))), *_DOT_PX))
    colours = np.rint(255 * cloud_colours(height, depth)).astype(np.uint8)
    half = (SIDE_PX - size - 2) / 2
    column = np.rint(half * (1 + seen[:, 0])).astype(int)
    row = np.rint(half * (1 - seen[:, 1])).astype(int)
    for dv in range(size):  # the nearest come last, and stay
        for du in range(size):
            picture[row + dv, column + du] = colours
    return _png(picture)


def around(
    depth_m: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "v u"], Bool[np.ndarray, "v u"]]:
    """Of both the part that `depth_png` shows, copied: a frame need not be kept for one object."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    side = max(np.ptp(rows), np.ptp(columns)) + 1
    half = int(side * (0.5 + _MARGIN)) + 4
    v, u = (int(rows[0] + rows[-1]) // 2, int(columns[0] + columns[-1]) // 2)
    at = slice(max(v - half, 0), v + half), slice(max(u - half, 0), u + half)
    return depth_m[at].copy(), mask[at].copy()


def depth_png(depth_m: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> bytes:
    """The part of a depth image around an object, near is light, with the outline of its pixels.

    Args:
        depth_m: 0 where nothing was measured, which is black.
        mask: what was pointed at; at least one pixel.
    """
    depth, own = around(depth_m, mask)
    measured = depth > 0
    grey = np.zeros(depth.shape)
    if measured.any():
        low, high = np.quantile(depth[measured], [0.02, 0.98])
        grey[measured] = 1 - 0.85 * unit(np.clip(depth[measured], low, high))
    picture = np.repeat(np.rint(255 * grey).astype(np.uint8)[..., None], 3, axis=2)
    scale = SIDE_PX / max(depth.shape)
    size = (max(int(depth.shape[1] * scale), 1), max(int(depth.shape[0] * scale), 1))
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST)
    large = cv2.resize(own.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    outlines, _ = cv2.findContours(large, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outlines, -1, _OUTLINE, 2)
    return _png(picture)


def _png(picture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """In 64 colours: a third of the bytes."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).quantize(64).save(file, format="png", optimize=True)
    return file.getvalue()
