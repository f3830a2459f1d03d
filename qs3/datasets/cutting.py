"""One object out of one depth image: by its mask, or by an oriented box less the floor.

    piece = cut(image, mask, "chair", rules)
    piece = cut(image, box_mask(image, box, rules), "chair", rules, edge_px=0)

What is cut is what the camera measured, with its holes and its fringes: nothing is filled in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from qs3.datasets.depth_images import DepthImage
from qs3.datasets.regions import Rules, body, eroded, occlusion, pieces, rim

CLEAN, HARD = "clean", "hard"
FEW = "few points"

_AROUND_M = 0.5  # the floor of a box is looked for so far around it
_FLOOR_WITHIN_M = 0.15  # and so far above or below its bottom
_FLOOR_LEAST = 200  # points
_PLATE = 0.9  # share of the points that must lie in a plate for the object to be flat


@dataclass(frozen=True, eq=False)
class Piece:
    """What was cut.

    Attributes:
        points_m: [n, 3] float32, z up, the camera at the origin; row by row in the picture.
        inlier: [n] whether a point is near its neighbours; see `Rules.outlier_sds`.
        pixels: with depth, that are the object's.
        holes: share of the mask without depth.
        kept: share of the measured pixels that are the object's; the others lie behind or before.
        rim: share of the outline that the picture's border cuts off.
        occ: share of the outline that something nearer covers.
        extent_m: along x, y and z.
        depth_m: median distance along the optical axis.
        tier: "clean" or "hard".
        why: what makes it hard; or with `refused`, what is wrong.
        refused: it cannot be used.
        own: the pixels of `points_m`; None where nothing was cut.
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
    tier: str = CLEAN
    why: str = ""
    refused: bool = False
    own: Bool[np.ndarray, "h w"] | None = None


@dataclass(frozen=True, eq=False)
class Box:
    """An oriented box in the frame with z up.

    Attributes:
        centre_m: [3].
        axes: [3, 3] rows are its unit directions.
        half_m: [3] half its size along each.
    """

    centre_m: Float[np.ndarray, " 3"]
    axes: Float[np.ndarray, "3 3"]
    half_m: Float[np.ndarray, " 3"]

    def holds(
        self, points_m: Float[np.ndarray, "*b 3"], margin_m: float = 0.0
    ) -> Bool[np.ndarray, "*b"]:
        """Whether each point is in it, made larger on all sides by `margin_m`."""
        within = np.abs((points_m - self.centre_m) @ self.axes.T) <= self.half_m + margin_m
        return within.all(axis=-1)

    @property
    def bottom_m(self) -> float:
        """Height of its lowest corner."""
        return float(self.centre_m[2] - np.abs(self.axes[:, 2]) @ self.half_m)


class Fault(NamedTuple):
    """One thing that is wrong with a piece.

    Attributes:
        kind: in a word or two: "few points", "holes", "size", "cut off", "covered", "torn", "flat".
        words: with its figure.
        refuses: it cannot be used; else it is hard.
    """

    kind: str
    words: str
    refuses: bool


def cut(
    image: DepthImage,
    mask: Bool[np.ndarray, "h w"],
    cls: str,
    rules: Rules,
    edge_px: int | None = None,
) -> Piece:
    """Cut the object of a mask, and judge it.

    Args:
        image: one depth image.
        mask: the object's pixels, of which some may be wrong.
        cls: its class, for the limits.
        rules: see there.
        edge_px: of the mask that are taken off; None: `rules.erode_px`.

    Returns:
        The object; or one that is `refused`, with the reason.
    """
    piece = cut_out(image, mask, rules, edge_px)
    found = faults(piece, cls, rules)
    if reasons := [fault.words for fault in found if fault.refuses]:
        few = [fault.words for fault in found if fault.kind == FEW]
        return replace(piece, refused=True, why=", ".join(few or reasons))
    return replace(
        piece, tier=HARD if found else CLEAN, why=", ".join(fault.kind for fault in found)
    )


def cut_out(
    image: DepthImage, mask: Bool[np.ndarray, "h w"], rules: Rules, edge_px: int | None = None
) -> Piece:
    """What of a mask is the object, measured but not judged.

    The mask loses its edge, where labels and depth do not agree to the pixel. What is measured of
    the rest is split where the depth jumps, and the largest piece stays with those that are near
    it in space. Arguments are those of `cut`. Without any depth the piece has no points.
    """
    mask = mask & image.inside
    depth = image.depth_m
    own, measured, core = own_pixels(image, mask, rules, edge_px)
    points = image.points_m[own]
    inlier, pixels, taken = inliers(points, rules), len(points), own
    if rules.drop_outliers:
        taken = own.copy()
        taken[own] = inlier
        points, inlier = points[inlier], inlier[inlier]
    holes = 1 - float(measured.sum()) / max(int(core.sum()), 1)
    piece = Piece(points.astype(np.float32), inlier, pixels, holes, own=taken)
    if pixels == 0:
        return piece
    extent = np.ptp(points[inlier], axis=0)
    return replace(
        piece,
        kept=pixels / int(measured.sum()),
        rim=rim(mask, image.inside, rules),
        occ=occlusion(mask, own, depth, rules),
        extent_m=(float(extent[0]), float(extent[1]), float(extent[2])),
        depth_m=float(np.median(depth[own])),
    )


def own_pixels(
    image: DepthImage, mask: Bool[np.ndarray, "h w"], rules: Rules, edge_px: int | None = None
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """The pixels that `cut` takes; those of the mask's core with depth; those of its core."""
    core = eroded(mask & image.inside, rules.erode_px if edge_px is None else edge_px)
    measured = core & (image.depth_m >= rules.near_m) & (image.depth_m <= rules.far_m)
    return body(pieces(measured, image.depth_m, rules), image.points_m, rules), measured, core


def faults(piece: Piece, cls: str, rules: Rules) -> list[Fault]:
    """All that is wrong with a piece, by the limits of its class; [] if it is clean."""
    limits, longest = rules.limits_of(cls), max(piece.extent_m)
    few = piece.pixels < limits.pixels
    size = not limits.least_m <= longest <= limits.most_m
    thin = not limits.thin and piece.pixels > 0
    flat = thin and thickness_m(piece.points_m[piece.inlier]) < rules.flat_m
    kept = f"{1 - piece.kept:.0%} of what was measured hangs elsewhere"
    found = (
        (few, FEW, f"{piece.pixels} pixels with depth, fewer than {limits.pixels}", True),
        (piece.holes > rules.most_holes, "holes", f"{piece.holes:.0%} of it without depth", True),
        (size, "size", f"{longest:.2f} m, not {limits.least_m:g} to {limits.most_m:g} m", True),
        (
            piece.rim > rules.clean_rim,
            "cut off",
            f"{piece.rim:.0%} of its outline cut off by the picture",
            piece.rim > rules.most_rim,
        ),
        (
            piece.occ > rules.clean_occ,
            "covered",
            f"{piece.occ:.0%} of its outline covered",
            piece.occ > rules.most_occ,
        ),
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
    inside = measured & box.holds(points, rules.box_margin_m)
    near = Box(box.centre_m, box.axes, box.half_m + _AROUND_M).holds(points) & measured
    level = np.abs(points[..., 2] - box.bottom_m) <= _FLOOR_WITHIN_M
    around = points[near & level & ~box.holds(points, rules.box_margin_m)]
    floor = float(np.median(around[:, 2])) if len(around) >= _FLOOR_LEAST else box.bottom_m
    above = np.maximum(rules.floor_m, rules.floor_share * image.depth_m)
    return inside & (points[..., 2] > floor + above)


def inliers(points_m: Float[np.ndarray, "n 3"], rules: Rules) -> Bool[np.ndarray, " n"]:
    """Which points are not far from their neighbours; see `Rules.outlier_sds`."""
    if len(points_m) <= rules.neighbours:
        return np.ones(len(points_m), dtype=bool)
    distance, _ = cKDTree(points_m).query(points_m, k=rules.neighbours + 1)
    mean = distance[:, 1:].mean(axis=1)
    near: Bool[np.ndarray, " n"] = mean <= mean.mean() + rules.outlier_sds * mean.std()
    return near


def thickness_m(points_m: Float[np.ndarray, "n 3"]) -> float:
    """Thickness of the thinnest plate about the mean that holds nine tenths of the points."""
    centred = points_m - points_m.mean(axis=0)
    _, _, axes = np.linalg.svd(centred.T @ centred)
    low, high = np.quantile(centred @ axes[2], [(1 - _PLATE) / 2, (1 + _PLATE) / 2])
    return float(high - low)
