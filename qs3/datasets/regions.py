"""Rules for objects that are cut from depth images, and the regions of a mask that they speak of.

Pieces of a mask hang together in depth. Of its outline a part may be cut off by the picture, or be
covered by something nearer. The values of the rules and their reasons are in conf/cutting; the
defaults here are the same, without the limits of the ten classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Ge, Gt
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from qs3.utils.settings import settings

_LEAST_PX = 20  # a piece below is dust: it is joined to nothing
_MOST_PIECES = 40  # looked at, the largest first
_SAMPLE = 2000  # points of a piece that the gap to others is measured with
_FAR = 1e9

NotNegative = Annotated[float, Ge(0)]
Pixels = Annotated[int, Ge(0)]


@settings
class Limits:
    """What an object of one class must be like.

    Attributes:
        pixels: an object has at least so many with depth.
        least_m, most_m: its largest extent along x, y or z is between these.
        thin: its things are thin by nature, so that being flat makes none of them hard.
    """

    pixels: Annotated[int, Ge(1)] = 700
    least_m: Annotated[float, Gt(0)] = 0.1
    most_m: Annotated[float, Gt(0)] = 3.5
    thin: bool = False


@settings
class Rules:
    """How an object is cut, and when it is refused.

    Attributes:
        near_m, far_m: depths outside do not count as measured.
        erode_px: taken off a mask all round; a box has no such edge.
        jump_m, jump_share: neighbouring pixels belong together if their depths differ by no more
            than the larger of the two, the second a share of the depth.
        bridge_px: pixels on both sides of a hole of up to so many pixels count as neighbours.
        join_m: pieces of one object that are this near to each other are put together.
        most_holes: refused above this share of the mask without depth.
        least_kept: hard below this share of the measured pixels in the object's own pieces.
        border_px: an outline so near to the picture's border is cut off by it.
        clean_rim, most_rim: share of the outline that the border cuts off: clean up to the first,
            refused above the second.
        reach_px: how far from an outline something nearer is looked for.
        clean_occ, most_occ: share of the outline that something nearer covers, likewise.
        flat_m: hard if its points lie within so thick a plate.
        neighbours, outlier_sds: a point is an outlier if its mean distance to so many neighbours
            is above the mean by so many standard deviations.
        drop_outliers: whether outliers are left out; else they are only counted.
        box_margin_m: a box is so much larger on all sides.
        floor_m, floor_share: of a box, points so near above the floor are the floor's; the larger
            of the two, the second a share of the depth.
        limits: by class; "default" for the others.
    """

    near_m: NotNegative = 0.5
    far_m: NotNegative = 6.0
    erode_px: Pixels = 1
    jump_m: NotNegative = 0.05
    jump_share: NotNegative = 0.03
    bridge_px: Pixels = 8
    join_m: NotNegative = 0.15
    most_holes: NotNegative = 0.6
    least_kept: NotNegative = 0.7
    border_px: Pixels = 2
    clean_rim: NotNegative = 0.02
    most_rim: NotNegative = 0.12
    reach_px: Pixels = 3
    clean_occ: NotNegative = 0.2
    most_occ: NotNegative = 0.5
    flat_m: NotNegative = 0.03
    neighbours: Annotated[int, Ge(1)] = 12
    outlier_sds: NotNegative = 2.0
    drop_outliers: bool = False
    box_margin_m: NotNegative = 0.02
    floor_m: NotNegative = 0.03
    floor_share: NotNegative = 0.01
    limits: dict[str, Limits] = field(default_factory=dict)

    @staticmethod
    def of(values: Mapping[str, Any] | None) -> Rules:
        """From a config's mapping."""
        return Rules(**(values or {}))

    def limits_of(self, cls: str) -> Limits:
        """Limits of a class: its own, or the default ones."""
        return self.limits.get(cls) or self.limits.get("default") or Limits()


def pieces(
    measured: Bool[np.ndarray, "h w"], depth_m: Float[np.ndarray, "h w"], rules: Rules
) -> Int[np.ndarray, "h w"]:
    """Number of each measured pixel's piece, the largest first (0, 1, ...); -1 elsewhere.

    Pixels next to each other in a row or column are of one piece unless their depth jumps; so are
    the two ends of a hole of at most `rules.bridge_px`.
    """
    count = int(measured.sum())
    number = np.full(measured.shape, -1, dtype=np.int64)
    if count == 0:
        return number
    number[measured] = np.arange(count)
    edges = []
    for pixels, depth in ((number, depth_m), (number.T, depth_m.T)):
        row, column = np.nonzero(pixels >= 0)  # along rows, from left to right
        z = depth[row, column]
        gap = column[1:] - column[:-1]
        jump = np.abs(z[1:] - z[:-1])
        allowed = np.maximum(rules.jump_m, rules.jump_share * np.minimum(z[1:], z[:-1]))
        near = (row[1:] == row[:-1]) & (gap <= rules.bridge_px + 1) & (jump <= allowed)
        index = pixels[row, column]
        edges.append(np.stack([index[1:][near], index[:-1][near]]))
    a, b = np.concatenate(edges, axis=1)
    graph = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(count, count))
    _, piece = connected_components(graph, directed=False)
    sizes = np.bincount(piece)
    order = np.argsort(-sizes, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    number[measured] = rank[piece]
    return number


def body(
    piece: Int[np.ndarray, "h w"], points_m: Float[np.ndarray, "h w 3"], rules: Rules
) -> Bool[np.ndarray, "h w"]:
    """The largest piece with all that lie within `rules.join_m` of it, directly or by others.

    An arm of a chair jumps out before its seat but is near it in space; the wall behind is not.
    """
    kept = piece == 0
    if not kept.any():
        return kept
    sizes = np.bincount(piece[piece >= 0])
    waiting = [k for k in range(1, min(len(sizes), _MOST_PIECES)) if sizes[k] >= _LEAST_PX]
    samples = {k: _some(points_m[piece == k]) for k in (0, *waiting)}
    newest, waiting = [0], list(waiting)
    while newest and waiting:
        tree = cKDTree(np.concatenate([samples[k] for k in newest]))
        newest = [k for k in waiting if tree.query(samples[k])[0].min() <= rules.join_m]
        waiting = [k for k in waiting if k not in newest]
        for k in newest:
            kept |= piece == k
    return kept


def _some(points: np.ndarray) -> np.ndarray:
    """At most so many of them, evenly."""
    return points[:: max(1, len(points) // _SAMPLE)]


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
