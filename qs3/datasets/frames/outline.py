"""How much of an object cannot be seen: cut off by the picture, or covered by something nearer."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from qs3.datasets.frames.rules import Rules

_FAR = 1e9


def eroded(mask: Bool[np.ndarray, "h w"], by_px: int) -> Bool[np.ndarray, "h w"]:
    """The mask without so many pixels all round; what lies beyond the picture counts as mask."""
    if by_px == 0:
        return mask
    window = np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8)
    found = cv2.erode(
        mask.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=(1,)
    )
    return found.astype(bool)


def outline(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The mask's pixels that have one beside, above or below them which is not the mask's."""
    padded = np.pad(mask, 1)
    around = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return mask & ~around


def rim(mask: Bool[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"], rules: Rules) -> float:
    """Share in [0, 1] of the outline that lies at the border of the picture, or of `inside`.

    Args:
        mask: of the object, within `inside`.
        inside: where the sensor can have measured at all; a rectangle.
        rules: how near the border is.
    """
    edge = outline(mask)
    if not edge.any():
        return 0.0
    near = np.pad(inside, 1)
    width = 2 * rules.border_px + 1
    near = cv2.erode(near.astype(np.uint8), np.ones((width, width), np.uint8))[1:-1, 1:-1] == 0
    return float((edge & near).sum() / edge.sum())


def occlusion(
    mask: Bool[np.ndarray, "h w"],
    own: Bool[np.ndarray, "h w"],
    depth_m: Float[np.ndarray, "h w"],
    rules: Rules,
) -> float:
    """Share in [0, 1] of the outline that something nearer covers.

    A pixel of the outline is covered if within `rules.reach_px` of it and outside the mask there
    is something nearer than the object, by more than a depth jump. The object's depth is that of
    its nearest measured pixel: at an edge there often is none.

    Args:
        mask: of the object.
        own: its measured pixels.
        depth_m: of all; 0 is a hole.
        rules: reach and jump.
    """
    if not mask.any() or not own.any():
        return 0.0
    at = _around(mask, rules.reach_px + 1)
    mask, own, depth_m = mask[at], own[at], depth_m[at]
    edge = outline(mask)
    row, column = distance_transform_edt(~own, return_distances=False, return_indices=True)
    object_depth = depth_m[row, column][edge]
    outside = np.where(~mask & (depth_m > 0), depth_m, _FAR)
    width = 2 * rules.reach_px + 1
    nearest = cv2.erode(
        outside,
        np.ones((width, width), np.uint8),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=(_FAR,),
    )[edge]
    jump = np.maximum(rules.jump_m, rules.jump_share * object_depth)
    return float((nearest < object_depth - jump).mean())


def _around(mask: Bool[np.ndarray, "h w"], margin_px: int) -> tuple[slice, slice]:
    """Rows and columns of the mask and so many more: most objects are a small part of a picture."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (
        slice(max(int(rows[0]) - margin_px, 0), int(rows[-1]) + margin_px + 1),
        slice(max(int(columns[0]) - margin_px, 0), int(columns[-1]) + margin_px + 1),
    )
