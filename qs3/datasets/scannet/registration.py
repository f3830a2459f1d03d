"""Which pixel of a mask, which has the colour camera's view, a pixel of the depth camera falls on.

A depth pixel is back-projected with the depth intrinsics, moved to the colour camera with the
extrinsics, and projected with the colour intrinsics, scaled to the mask's resolution. What the
colour camera cannot see, because something nearer hides it from there and not from the depth
camera, gets no mask pixel: it would get the label of what hides it.
"""

from __future__ import annotations

import cv2
import numpy as np

from qs3.datasets.scannet.sens import SensHeader
from qs3.errors import DataError

# Two surfaces are told apart as nearer and farther if their depths differ by more than this.
_FARTHER = 0.05
# A cell of the nearest-surface map, in depth pixels: each cell of a visible surface gets a sample.
_CELL_DEPTH_PX = 2.0
_SAME_PLACE_M = 1e-6


class Registration:
    """The depth camera and the masks of one resolution."""

    def __init__(self, header: SensHeader, mask_shape: tuple[int, int], where: str) -> None:
        """Prepare the rays for masks [h, w]; DataError if colour images have another shape."""
        height, width = mask_shape
        scale = (width / header.colour_width_px, height / header.colour_height_px)
        # Half a pixel of slack: a halved image of odd height is rounded.
        if abs(scale[0] / scale[1] - 1) > 1 / min(mask_shape):
            raise DataError(
                f"{where}: masks of {width} x {height} px do not fit colour images of "
                f"{header.colour_width_px} x {header.colour_height_px} px"
            )
        k = header.colour_intrinsics
        self._focal = (k[0, 0] * scale[0], k[1, 1] * scale[1])
        self._skew = k[0, 1] * scale[0]
        # Pixel centres are integers, so an image's edge is at -0.5.
        self._centre = tuple((k[i, 2] + 0.5) * scale[i] - 0.5 for i in (0, 1))
        self._mask_shape = mask_shape
        u, v = np.meshgrid(
            np.arange(header.depth_width_px, dtype=np.float64),
            np.arange(header.depth_height_px, dtype=np.float64),
        )
        pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
        self._rays = pixels @ np.linalg.inv(header.depth_intrinsics).T
        move = header.colour_from_depth
        self._turned, self._shift = self._rays @ move[:3, :3].T, move[:3, 3]
        self._parallax = bool(np.linalg.norm(self._shift) > _SAME_PLACE_M)
        self._cell_px = _CELL_DEPTH_PX * max(1.0, self._focal[0] / header.depth_intrinsics[0, 0])

    def mask_pixels(self, depth_m: np.ndarray, near_m: float, far_m: float) -> np.ndarray:
        """Where each depth pixel falls in the mask: [h, w] int64, nearest position, flattened.

        It is -1 outside the mask, where a thing is hidden from the colour camera, and where the
        depth [h, w] is 0 (nothing was measured), below `near_m` or above `far_m`.
        """
        rows, cols = np.nonzero((depth_m >= near_m) & (depth_m <= far_m))
        at = self._turned[rows, cols] * depth_m[rows, cols, None].astype(np.float64) + self._shift
        x, y, z = at.T
        ahead = z > 0
        safe = np.where(ahead, z, 1.0)
        u = (self._focal[0] * x + self._skew * y) / safe + self._centre[0]
        v = self._focal[1] * y / safe + self._centre[1]
        height, width = self._mask_shape
        seen = ahead & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        if self._parallax:
            seen[seen] = self._visible(u[seen], v[seen], z[seen])
        found = np.full(depth_m.shape, -1, dtype=np.int64)
        col, row = np.rint(u[seen]).astype(np.int64), np.rint(v[seen]).astype(np.int64)
        found[rows[seen], cols[seen]] = row * width + col
        return found

    def world(self, depth_m: np.ndarray, keep: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """[n, 3] float64 world points of pixels `keep` [h, w] bool; `pose` is world_from_depth."""
        local = self._rays[keep] * depth_m[keep, None].astype(np.float64)
        return local @ pose[:3, :3].T + pose[:3, 3]

    def _visible(self, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> np.ndarray:
        """[n] bool: nothing clearly nearer lies in the point's cell or one next to it.

        The cells next to it stand for sides of a nearer thing that only the colour camera sees:
        no depth was measured there. It costs what lies behind an edge a few pixels.
        """
        height, width = self._mask_shape
        col = ((u + 0.5) / self._cell_px).astype(np.int64)
        row = ((v + 0.5) / self._cell_px).astype(np.int64)
        cells = (int(height / self._cell_px) + 1, int(width / self._cell_px) + 1)
        nearest = np.full(cells[0] * cells[1], np.inf)
        cell = row * cells[1] + col
        np.minimum.at(nearest, cell, z)
        around = cv2.erode(nearest.reshape(cells), np.ones((3, 3), np.uint8))
        return z <= (1 + _FARTHER) * around.ravel()[cell]


def agreed(mask: np.ndarray, margin_px: int) -> np.ndarray:
    """The mask, 0 where a pixel within `margin_px` is of something else.

    With a margin of 1 px a ray that misses an object by less than a pixel is not taken for it:
    what it hits lies far behind, and farthest point sampling would keep every such point. The mask
    is [h, w] uint8 or uint16; a margin of 0 leaves it as it is.
    """
    if margin_px == 0:
        return mask
    square = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    return np.where(cv2.erode(mask, square) == cv2.dilate(mask, square), mask, 0).astype(mask.dtype)
