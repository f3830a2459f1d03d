"""Objects that somebody points at in a depth image, by a mask or a box in pixels.

    objects = point_out(depth_m, camera, mask=mask)          # one a number of the mask
    objects = point_out(depth_m, camera, box=(210, 95, 480, 430), up=(0, -0.97, -0.24))

The rules for objects of datasets (`qs3.datasets.cutting.Rules`) do not refuse here, they caution:
who points at a thing wants to know what it is. A thing without any depth in its pixels is an error.

Of a box, the object is what lies in it and not on the plane it stands on, and of that the pieces
that do not go on outside the box, as floors and walls do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.datasets.cutting import HARD, Fault, Piece, Rules, body, cut, pieces
from qs3.datasets.depth_images import CAMERA_UP, DepthImage, Pinhole, checked_mask, upright
from qs3.datasets.vertical import angle_deg, planes_up_steep
from qs3.errors import DataError

RULES = Rules(near_m=0.1, far_m=10.0)
"""Any sensor's range, and limits of no class."""

POOR = "poor"
"""The tier of what the importers of datasets would leave out."""

GIVEN, PLANES, LEVEL = "given", "planes", "level"
"""How up is known: given, fitted to the planes of the picture, or up in the picture."""

BOX = "box"
"""The kind of caution of a box that does not part its object from what is around it."""

_MOST_TILT_DEG = 90.0  # of an up that is given: beyond, it is down
_MOST_OFF_DEG = 20.0  # from an up that is given to that of the planes
_AROUND = 0.25  # of a box's sides, looked at around it
_AROUND_PX = 12  # at least
_BIN_M = 0.02
_LEVEL_M = 0.06  # so far from the commonest height a point may be the support's
_LEAST_SUPPORT = 0.15  # share of the points next to and below a box that a support has
_LEAST_PX = 60
_OWN = 0.6  # share of a piece that must lie within the box for it not to be background
_JOIN = 0.2  # of the size of a box's largest piece: what is so near is of the same object
_TRIM = 3.0  # median absolute deviations
_STEEPEST = np.cos(np.deg2rad(20.0))  # of a support


@dataclass(frozen=True, eq=False)
class Pointed:
    """One object.

    Attributes:
        name: "[3]", the number in the mask; "[210,95,480,430]", the box; "" where a mask of bool
            has but one.
        piece: its points, metres, z up, the camera at the origin; none if `why`.
        mask: [h, w] its pixels as pointed at.
        without_depth: how many of them have none.
        tier: "clean", "hard" or "poor".
        cautions: what makes it so, and what is not sure about the picture.
        up: how it is known.
        world_from_camera: [3, 3] the rotation to z up.
        why: it cannot be used; "" otherwise.
    """

    name: str
    piece: Piece
    mask: Bool[np.ndarray, "h w"]
    without_depth: int
    tier: str
    cautions: tuple[Fault, ...]
    up: str
    world_from_camera: Float[np.ndarray, "3 3"]
    why: str = ""

    def cloud(self, gravity: str) -> Float[np.ndarray, "n 3"]:
        """Its points with z up, or with the `gravity` "none" in the camera's frame."""
        if gravity == "none":
            return self.piece.points_m @ np.asarray(self.world_from_camera, dtype=np.float32)
        return self.piece.points_m


def point_out(
    depth_m: Float[np.ndarray, "h w"],
    camera: Pinhole,
    *,
    mask: Int[np.ndarray, "h w"] | Bool[np.ndarray, "h w"] | None = None,
    box: Sequence[float] | None = None,
    up: Sequence[float] | None = None,
) -> list[Pointed]:
    """The objects of a mask, by their numbers, or the one of a box.

    Args:
        depth_m: along the optical axis; 0 or not finite where nothing was measured.
        camera: that took it.
        mask: 0 where no object is, else its number.
        box: left, top, right, bottom in pixels; what lies beyond the picture is cut off.
        up: direction in camera coordinates (x right, y down, z forward) of any length; None: by
            the planes of the picture, and if it has none up in the picture.
    """
    assert (mask is None) != (box is None), "a depth image takes a mask or a box, and not both"
    way, how, unsure = _vertical(DepthImage(depth_m, camera, np.eye(3)), up)
    image = DepthImage(depth_m, camera, upright(way))
    if box is not None:
        sides = _sides(box, image.depth_m.shape)
        found, odd = in_box(image, sides)
        name = "[" + ",".join(f"{value:g}" for value in box) + "]"
        if not found.any():
            found[sides[0] : sides[1], sides[2] : sides[3]] = True  # as pointed at
        return [_judged(name, image, found, 0, how, (*unsure, *odd))]
    assert mask is not None
    numbers = checked_mask(np.asarray(mask), "the mask")
    if numbers.shape != image.depth_m.shape:
        raise DataError(f"the mask is {numbers.shape}, the depth image {image.depth_m.shape}")
    single = np.asarray(mask).dtype.kind == "b"
    return [
        _judged("" if single else f"[{n}]", image, numbers == n, RULES.erode_px, how, unsure)
        for n in np.unique(numbers[numbers != 0]).tolist()
    ]


def _judged(
    name: str,
    image: DepthImage,
    mask: Bool[np.ndarray, "h w"],
    edge_px: int,
    how: str,
    unsure: Sequence[Fault],
) -> Pointed:
    piece = cut(image, mask, "", RULES, edge_px)
    if not piece.pixels and edge_px:  # so thin that nothing else is there
        piece = cut(image, mask, "", RULES, 0)
    without, turn = int((mask & (image.depth_m <= 0)).sum()), image.world_from_camera
    if not piece.pixels:
        why = f"none of its {int(mask.sum())} pixels has depth"
        if (mask & (image.depth_m > 0)).any():
            why += f" from {RULES.near_m:g} to {RULES.far_m:g} m"
        return Pointed(name, piece, mask, without, POOR, (), how, turn, why)
    boxed = any(caution.kind == BOX for caution in unsure)
    tier = POOR if piece.refused else HARD if boxed else piece.tier
    cautions = (*piece.faults, *unsure)
    return Pointed(name, piece, mask, without, tier, cautions, how, turn)


def _vertical(
    image: DepthImage, up: Sequence[float] | None
) -> tuple[np.ndarray, str, tuple[Fault, ...]]:
    """Up in camera coordinates, how it is known, and what is not sure about it."""
    fitted, sure = planes_up_steep(image.depth_m, image.camera)
    words = ""
    if up is not None:
        way, how = np.asarray(up, dtype=np.float64), GIVEN
        length = float(np.linalg.norm(way))
        if way.shape != (3,) or not np.isfinite(length) or length < 1e-9:
            raise DataError(f"up={list(up)} is not a direction x,y,z in the camera's frame")
        tilt = angle_deg(way / length, CAMERA_UP)
        off = 0.0 if fitted is None or not sure else angle_deg(fitted, way / length)
        if tilt > _MOST_TILT_DEG:
            words = (
                f"up points {tilt:.0f}° away from up in the picture; a level camera has up=0,-1,0"
            )
        elif fitted is not None and off > _MOST_OFF_DEG:
            shown = ",".join(f"{value:.2f}" for value in fitted)
            words = f"by the planes of the picture up={shown}, {off:.0f}° from what is given"
    elif fitted is not None:
        way, how = fitted, PLANES
        if not sure:
            words = "the planes of the picture leave open what is level; give up=x,y,z"
    else:
        way, how = CAMERA_UP, LEVEL
        words = "up is not known: the picture shows no planes, so the camera counts as level"
    return way, how, (Fault("up", words),) if words else ()


def _sides(box: Sequence[Any], shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Rows from, to and columns from, to of a box within the picture."""
    height, width = shape
    left, top, right, bottom = (float(value) for value in box)
    rows = max(int(np.floor(top)), 0), min(int(np.ceil(bottom)), height)
    columns = max(int(np.floor(left)), 0), min(int(np.ceil(right)), width)
    if rows[0] >= rows[1] or columns[0] >= columns[1] or max(right, bottom) <= 1:
        raise DataError(f"box={list(box)} is not left,top,right,bottom in {width} x {height} px")
    return *rows, *columns


def in_box(
    image: DepthImage, sides: tuple[int, int, int, int]
) -> tuple[Bool[np.ndarray, "h w"], tuple[Fault, ...]]:
    """The pixels of a box's object, and cautions.

    What the object stands on is the plane, within 20° of level, that most points next to and below
    the box lie on; its points and those beneath go. What is left, in the box and around it, is
    parted where the depth jumps: of the pieces that lie within the box the one that is largest and
    fills it best is the object, with those near it. `image` has z up; `sides` are rows from, to
    and columns from, to.
    """
    top, bottom, left, right = sides
    height, width = image.depth_m.shape
    dv = max(int((bottom - top) * _AROUND), _AROUND_PX)
    du = max(int((right - left) * _AROUND), _AROUND_PX)
    at = (
        slice(max(top - dv, 0), min(bottom + dv, height)),
        slice(max(left - du, 0), min(right + du, width)),
    )
    inner = np.zeros(image.depth_m.shape, dtype=bool)
    inner[top:bottom, left:right] = True
    depth, points, inside = image.depth_m[at], image.points_m[at], inner[at]
    measured = (depth >= RULES.near_m) & (depth <= RULES.far_m)
    low = np.zeros_like(inside)
    low[top - at[0].start + 2 * (bottom - top) // 3 :] = True
    height_m = _above_support(points, measured & low & ~inside)
    above = np.maximum(RULES.floor_m, RULES.floor_share * depth)
    left_over = measured if height_m is None else measured & (height_m > above)
    result = np.zeros_like(inner)
    if not (left_over & inside).any():
        result[at] = inside & measured
        return result, (Fault(BOX, "all in the box is the plane that things stand on"),)
    number = pieces(left_over, depth, RULES)
    everywhere = np.bincount(number[left_over])
    within = np.bincount(number[inside & left_over], minlength=len(everywhere))
    own = within >= np.maximum(_OWN * everywhere, 1)
    if (within * own).max() < max(0.05 * within.max(), _LEAST_PX):
        result[at] = inside & left_over
        words = "what lies in the box goes on outside of it; a mask shows more than a box"
        return result, (Fault(BOX, words),)
    number = np.where(inside & np.isin(number, np.flatnonzero(own)), number, -1)
    fits = (within * own).astype(np.float64)
    for k in np.flatnonzero(fits):
        fits[k] *= _fit(number == k, inside) if fits[k] >= _LEAST_PX else 0.0
    order = np.argsort(-fits, kind="stable")
    number[number >= 0] = np.argsort(order)[number[number >= 0]]  # the best is 0
    size = float(np.ptp(points[number == 0], axis=0).max())
    result[at] = body(number, points, replace(RULES, join_m=min(RULES.join_m, _JOIN * size)))
    return result, ()


def _fit(piece: Bool[np.ndarray, "h w"], box: Bool[np.ndarray, "h w"]) -> float:
    """Share in [0, 1] of a box, all in one picture, that the box about a piece within it fills."""
    rows, columns = np.flatnonzero(piece.any(axis=1)), np.flatnonzero(piece.any(axis=0))
    return float((np.ptp(rows) + 1) * (np.ptp(columns) + 1) / box.sum())


def _above_support(
    points_m: Float[np.ndarray, "h w 3"], candidates: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"] | None:
    """Height of each point above the plane that most candidates lie on; None if they have none."""
    given = points_m[candidates]
    if len(given) < _LEAST_PX:
        return None
    bins = np.floor(given[:, 2] / _BIN_M).astype(np.int64)
    first = bins.min()
    counts = np.convolve(np.bincount(bins - first), np.ones(3), "same")
    middle = (first + int(counts.argmax()) + 0.5) * _BIN_M
    near = given[np.abs(given[:, 2] - middle) <= _LEVEL_M]
    if len(near) < max(_LEAST_SUPPORT * len(given), _LEAST_PX):
        return None
    for _ in range(4):
        centre = near.mean(axis=0)
        _, _, axes = np.linalg.svd((near - centre).T @ (near - centre))
        normal = axes[2] * np.sign(axes[2, 2] or 1.0)
        if normal[2] < _STEEPEST:
            return None
        off = (given - centre) @ normal
        scale = max(1.4826 * float(np.median(np.abs((near - centre) @ normal))), 2e-3)
        near = given[np.abs(off) <= _TRIM * scale]
    found: np.ndarray = (points_m - centre) @ normal
    return found
