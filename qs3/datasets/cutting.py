"""One object out of one depth image: by its mask, or by an oriented box less the floor.

    piece = cut(image, mask, "chair", rules)
    piece = cut(image, box_mask(image, box, rules), "chair", rules, edge_px=0)

What is cut is what the camera measured, with its holes and its fringes: nothing is filled in. The
values of the rules and their reasons are in conf/cutting; the defaults here are the same, without
the limits of the ten classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import cv2
import numpy as np
import scipy  # imports its parts when they are used, some of them slowly
from annotated_types import Ge, Gt
from jaxtyping import Bool, Float, Int

from qs3.datasets.depth_images import DepthImage
from qs3.datasets.picture_kernels import connected
from qs3.utils.settings import Count, NotNegative, settings

CLEAN, HARD = "clean", "hard"
FEW = "few points"

_AROUND_M = 0.5  # the floor of a box is looked for so far around it
_FLOOR_WITHIN_M = 0.15  # and so far above or below its bottom
_FLOOR_LEAST = 200  # points
_PLATE = 0.9  # share of the points that must lie in a plate for the object to be flat
_LEAST_PX = 20  # a piece below is dust: it is joined to nothing
_MOST_PIECES = 40  # looked at, the largest first
_SAMPLE = 2000  # points of a piece that the gap to others is measured with
_FAR = 1e9

Pixels = Annotated[int, Ge(0)]


@settings
class Limits:
    """What an object of one class must be like.

    Attributes:
        pixels: an object has at least so many with depth.
        least_m, most_m: its largest extent along x, y or z is between these.
        thin: its things are thin by nature, so that being flat makes none of them hard.
    """

    pixels: Count = 700
    least_m: Annotated[float, Gt(0)] = 0.1
    most_m: Annotated[float, Gt(0)] = 3.5
    thin: bool = False


@settings
class Rules:
    """How an object is cut, and when it is refused; conf/cutting/raw.yaml explains each rule.

    Lengths are in metres (_m) or pixels (_px), shares in [0, 1]. Where there are two, clean_ and
    most_: above the first an object is hard, above the second it is refused.

    Attributes:
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
    neighbours: Count = 12
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


class Fault(NamedTuple):
    """What is wrong with a piece, in a word or two and with its figure; else a caution about it.

    A fault that `refuses` makes the piece useless, else it is hard.
    """

    kind: str
    words: str
    refuses: bool = False


@dataclass(frozen=True, eq=False)
class Piece:
    """What was cut.

    Attributes:
        points_m: [n, 3] float32, z up, the camera at the origin; row by row in the picture.
        inlier: [n] whether a point is near its neighbours; see `Rules.outlier_sds`.
        pixels: with depth, that are the object's.
        holes: share of the mask without depth.
        kept: share of the measured pixels that are the object's; the others lie behind or before.
        rim, occ: share of the outline that the picture's border cuts off, and that something
            nearer covers.
        extent_m: along x, y and z.
        depth_m: median distance along the optical axis.
        faults: what is wrong with it, once it was judged.
    """

    points_m: Float[np.ndarray, "n 3"]
    inlier: Bool[np.ndarray, " n"]
    pixels: int
    holes: float
    kept: float = 1.0
    rim: float = 0.0
    occ: float = 0.0
    extent_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    depth_m: float = 0.0
    faults: tuple[Fault, ...] = ()

    @property
    def refused(self) -> bool:
        """Whether it cannot be used."""
        return any(fault.refuses for fault in self.faults)

    @property
    def tier(self) -> str:
        """Clean without faults, else hard."""
        return HARD if self.faults else CLEAN

    @property
    def why(self) -> str:
        """What makes it hard, or why it is refused."""
        if not self.refused:
            return ", ".join(fault.kind for fault in self.faults)
        few = [fault.words for fault in self.faults if fault.kind == FEW]
        return ", ".join(few or [fault.words for fault in self.faults if fault.refuses])


@dataclass(frozen=True, eq=False)
class Box:
    """An oriented box in the frame with z up: its centre, unit axes as rows, and half its sizes."""

    centre_m: Float[np.ndarray, " 3"]
    axes: Float[np.ndarray, "3 3"]
    half_m: Float[np.ndarray, " 3"]

    def holds(self, points_m: Float[np.ndarray, "*b 3"], margin_m: float) -> Bool[np.ndarray, "*b"]:
        """Whether each point is in it, made larger on all sides by `margin_m`."""
        within = np.abs((points_m - self.centre_m) @ self.axes.T) <= self.half_m + margin_m
        return within.all(axis=-1)


def cut(
    image: DepthImage,
    mask: Bool[np.ndarray, "h w"],
    cls: str,
    rules: Rules,
    edge_px: int | None = None,
) -> Piece:
    """Cut the object of a mask, of which some pixels may be wrong, and judge it.

    The mask loses `edge_px` pixels (None: `rules.erode_px`) of its edge, where labels and depth do
    not agree to the pixel. What is measured of the rest is split where the depth jumps, and the
    largest piece stays with those that are near it in space. `cls` chooses the limits. Without any
    depth it has no points.
    """
    mask = mask & image.inside
    measured, core = measured_pixels(image, mask, rules, edge_px)
    own = body(pieces(measured, image.depth_m, rules), image.points_m, rules)
    points = image.points_m[own]
    inlier, pixels = inliers(points, rules), len(points)
    if rules.drop_outliers:
        points, inlier = points[inlier], inlier[inlier]
    holes = 1 - float(measured.sum()) / max(int(core.sum()), 1)
    piece = Piece(points.astype(np.float32), inlier, pixels, holes)
    if pixels:
        x, y, z = np.ptp(points[inlier], axis=0).tolist()
        piece = replace(
            piece,
            kept=pixels / int(measured.sum()),
            rim=rim(mask, image.inside, rules),
            occ=occlusion(mask, own, image.depth_m, rules),
            extent_m=(x, y, z),
            depth_m=float(np.median(image.depth_m[own])),
        )
    return replace(piece, faults=tuple(faults(piece, cls, rules)))


def measured_pixels(
    image: DepthImage, mask: Bool[np.ndarray, "h w"], rules: Rules, edge_px: int | None = None
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """The pixels of the mask's core with depth in range; those of its core."""
    edge_px = rules.erode_px if edge_px is None else edge_px
    core = _least((mask & image.inside).astype(np.uint8), edge_px, 1) > 0
    return core & (image.depth_m >= rules.near_m) & (image.depth_m <= rules.far_m), core


def faults(piece: Piece, cls: str, rules: Rules) -> list[Fault]:
    """All that is wrong with a piece, by the limits of its class; [] if it is clean."""
    limits, longest = rules.limits_of(cls), max(piece.extent_m)
    few = piece.pixels < limits.pixels
    size = not limits.least_m <= longest <= limits.most_m
    thin = not limits.thin and piece.pixels > 0
    flat = thin and _thickness_m(piece.points_m[piece.inlier]) < rules.flat_m
    off = f"{piece.rim:.0%} of its outline cut off by the picture"
    covered = f"{piece.occ:.0%} of its outline covered"
    kept = f"{1 - piece.kept:.0%} of what was measured hangs elsewhere"
    found = (
        (few, FEW, f"{piece.pixels} pixels with depth, fewer than {limits.pixels}", True),
        (piece.holes > rules.most_holes, "holes", f"{piece.holes:.0%} of it without depth", True),
        (size, "size", f"{longest:.2f} m, not {limits.least_m:g} to {limits.most_m:g} m", True),
        (piece.rim > rules.clean_rim, "cut off", off, piece.rim > rules.most_rim),
        (piece.occ > rules.clean_occ, "covered", covered, piece.occ > rules.most_occ),
        (piece.kept < rules.least_kept, "torn", kept, False),
        (flat, "flat", f"it lies in a plate of {rules.flat_m * 100:g} cm", False),
    )
    return [Fault(kind, words, refuses) for there, kind, words, refuses in found if there]


def box_mask(image: DepthImage, box: Box, rules: Rules) -> Bool[np.ndarray, "h w"]:
    """The pixels whose points are in the box and not on the floor.

    The floor's height is the median of the points around the box that are about as high as its
    bottom; where there are too few, it is the bottom itself. Of an object that stands on something
    else (a lamp on a table) it is that thing's top.
    """
    points, measured = image.points_m, image.depth_m > 0
    within = box.holds(points, rules.box_margin_m)
    bottom_m = float(box.centre_m[2] - np.abs(box.axes[:, 2]) @ box.half_m)
    level = np.abs(points[..., 2] - bottom_m) <= _FLOOR_WITHIN_M
    around = points[box.holds(points, _AROUND_M) & measured & level & ~within]
    floor = float(np.median(around[:, 2])) if len(around) >= _FLOOR_LEAST else bottom_m
    above = np.maximum(rules.floor_m, rules.floor_share * image.depth_m)
    return measured & within & (points[..., 2] > floor + above)


def pieces(
    measured: Bool[np.ndarray, "h w"], depth_m: Float[np.ndarray, "h w"], rules: Rules
) -> Int[np.ndarray, "h w"]:
    """Number of each measured pixel's piece, the largest first (0, 1, ...); -1 elsewhere.

    Pixels next to each other in a row or column are of one piece unless their depth jumps; so are
    the two ends of a hole of at most `rules.bridge_px`.
    """
    number = connected(depth_m, measured, rules.jump_m, rules.jump_share, rules.bridge_px)
    piece = number[measured]
    if len(piece):
        order = np.argsort(-np.bincount(piece), kind="stable")
        number[measured] = np.argsort(order)[piece]
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
    samples = {}
    for k in (0, *waiting):
        points = points_m[piece == k]
        samples[k] = points[:: max(1, len(points) // _SAMPLE)]
    newest = [0]
    while newest and waiting:
        tree = scipy.spatial.cKDTree(np.concatenate([samples[k] for k in newest]))
        newest = [k for k in waiting if tree.query(samples[k])[0].min() <= rules.join_m]
        waiting = [k for k in waiting if k not in newest]
        for k in newest:
            kept |= piece == k
    return kept


def rim(mask: Bool[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"], rules: Rules) -> float:
    """Share in [0, 1] of the mask's outline at the border of `inside`, a rectangle.

    Inside is where the sensor can have measured at all; the mask lies within it.
    """
    edge = _outline(mask)
    far = _least(np.pad(inside, 1).astype(np.uint8), rules.border_px, 1)[1:-1, 1:-1]
    return float((edge & (far == 0)).sum() / max(edge.sum(), 1))


def occlusion(
    mask: Bool[np.ndarray, "h w"],
    own: Bool[np.ndarray, "h w"],
    depth_m: Float[np.ndarray, "h w"],
    rules: Rules,
) -> float:
    """Share in [0, 1] of the outline that something nearer covers.

    A pixel of the outline is covered if within `rules.reach_px` of it and outside the mask there
    is something nearer than the object, by more than a depth jump. The object's depth is that of
    its nearest measured pixel (of `own`): at an edge there often is none.
    """
    if not mask.any() or not own.any():
        return 0.0
    margin = rules.reach_px + 1  # most objects are a small part of a picture
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    at = (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + margin + 1),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + margin + 1),
    )
    mask, own, depth_m = mask[at], own[at], depth_m[at]
    edge = _outline(mask)
    row, column = scipy.ndimage.distance_transform_edt(
        ~own, return_distances=False, return_indices=True
    )
    object_depth = depth_m[row, column][edge]
    outside = np.where(~mask & (depth_m > 0), depth_m, _FAR)
    nearest = _least(outside, rules.reach_px, _FAR)[edge]
    jump = np.maximum(rules.jump_m, rules.jump_share * object_depth)
    return float((nearest < object_depth - jump).mean())


def inliers(points_m: Float[np.ndarray, "n 3"], rules: Rules) -> Bool[np.ndarray, " n"]:
    """Whether each point's mean distance to its neighbours is like the others'."""
    if len(points_m) <= rules.neighbours or not rules.outlier_sds:
        return np.ones(len(points_m), dtype=bool)
    distance, _ = scipy.spatial.cKDTree(points_m).query(points_m, k=rules.neighbours + 1)
    mean = distance[:, 1:].mean(axis=1)
    near: Bool[np.ndarray, " n"] = mean <= mean.mean() + rules.outlier_sds * mean.std()
    return near


def _thickness_m(points_m: Float[np.ndarray, "n 3"]) -> float:
    """Thickness of the thinnest plate about the mean that holds nine tenths of the points."""
    centred = points_m - points_m.mean(axis=0)
    _, _, axes = np.linalg.svd(centred.T @ centred)
    low, high = np.quantile(centred @ axes[2], [(1 - _PLATE) / 2, (1 + _PLATE) / 2])
    return float(high - low)


def _least(image: np.ndarray, reach_px: int, beyond: float) -> np.ndarray:
    """[h, w] the least value in a square about each pixel; `beyond` lies outside of the picture."""
    square = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    return cv2.erode(image, square, borderType=cv2.BORDER_CONSTANT, borderValue=(beyond,))


def _outline(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The mask's pixels that have one next to, above or below them which is not the mask's."""
    padded = np.pad(mask, 1)
    around = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return mask & ~around
