"""The wall in a depth image, and how the camera measures it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from qs3.errors import DataError
from qs3.geometry.cameras import Intrinsics

_TRIES = 300
_LEAST_PURE = 0.6  # share of the depths within the outline of the wall that lie on it
_LEAST_PIXELS = 2000
_LEAST_INSIDE = 400  # of its pixels within the rim
_LEAST_THING = 50  # pixels that lie together off the wall and are not its noise
_RIM = 40  # the rim left out is this part of the image's width
_SHADOW = 12  # a shadow is narrower than this part of the image
_WIDE = 0.02  # of 1 / Z, relative: what the first fit takes for the wall
_LARGEST_ERROR = 0.08  # of 1 / Z, relative: no depth camera is as bad, and boxes of noise are
_BEND_SURE = 2.0  # standard errors from which the middle of a wall is not on its plane
PATCH_PX = 24
"""Side of the patches that errors are averaged over: noise is smooth over a few pixels at most."""


@dataclass(frozen=True, eq=False)
class Wall:
    """The dominant plane of one frame.

    Attributes:
        name: of the frame.
        depth_m: [h, w] measured, NaN where nothing was or where something else is.
        plane_m: [h, w] depth of the fitted plane.
        tilt_deg: [h, w] angle of incidence on it.
        region: [h, w] bool: where the wall is seen, holes included.
        centre_m: its measured distance at the principal point.
        centre_error_m: standard error of that, from noise alone.
        gap_per_m: usual gap between the levels of 1 / Z that are seen on it; 0 without levels.
    """

    name: str
    depth_m: np.ndarray
    plane_m: np.ndarray
    tilt_deg: np.ndarray
    region: np.ndarray
    centre_m: float
    centre_error_m: float
    gap_per_m: float

    @property
    def on_wall(self) -> np.ndarray:
        """[h, w] bool: measured, and on the wall."""
        return self.region & np.isfinite(self.depth_m)


def find_wall(name: str, depth_m: np.ndarray, camera: Intrinsics, seed: int = 0) -> Wall:
    """Fit the plane that most pixels of `depth_m` [h, w] with NaN lie on.

    A plane is linear in 1 / Z over the pixels, so the fit is linear and its errors are those of a
    disparity. Random triples first (the one with the lowest 30 % quantile of errors), then least
    squares on what lies within 4.5 standard deviations, eight times.

    Raises:
        DataError: there is no plane, or it covers too little; the message begins with `name`.
    """
    seen = np.isfinite(depth_m)
    rows, cols = np.nonzero(seen)
    x = (cols - camera.cx_px) / camera.focal_px
    y = (rows - camera.cy_px) / camera.focal_px
    inverse = 1 / depth_m[rows, cols]
    design = np.stack([np.ones_like(x), x, y], axis=1)
    normal = _plane_of_three(design, inverse, np.random.default_rng(seed))
    if normal is None:
        raise DataError(f"{name}: no plane was found")
    fit = _least_squares(normal, design, inverse)
    if fit.near.sum() < max(_LEAST_PIXELS, 0.05 * len(x)):
        raise DataError(
            f"{name}: only {int(fit.near.sum())} pixels lie on one plane; show the camera a flat "
            "wall"
        )
    if fit.error_per_m > _LARGEST_ERROR * float(np.median(inverse)):
        raise DataError(
            f"{name}: no plane was found; the best one leaves an error of "
            f"{100 * fit.error_per_m / float(np.median(inverse)):.0f} %. Show the camera a flat "
            "wall"
        )
    mask = np.zeros(depth_m.shape, dtype=np.uint8)
    mask[rows[fit.near], cols[fit.near]] = 1
    about = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((15, 15), np.uint8)) > 0
    pure = mask.sum() / max((about & seen).sum(), 1)
    if pure < _LEAST_PURE:
        raise DataError(
            f"{name}: no plane was found; of the pixels about the best one only {100 * pure:.0f} % "
            "lie on it. Show the camera a flat wall"
        )
    measured = np.where(mask > 0, depth_m, np.nan)
    plane, tilt = _view(fit.normal, camera, depth_m.shape)
    region = _region(mask > 0, seen)
    inside = int((region & (mask > 0)).sum())
    if inside < _LEAST_INSIDE:
        raise DataError(
            f"{name}: only {inside} pixels of the wall are further from its edges than a "
            f"{_RIM}th of the image; let it fill more of the view"
        )
    with np.errstate(divide="ignore"):
        found, error = _centre(fit, design[fit.near], 1 / measured - 1 / plane, camera)
    return Wall(name, measured, plane, tilt, region, found, error, fit.gap_per_m)


class _Fit(NamedTuple):
    """A plane by least squares, in 1 / Z.

    Attributes:
        normal: [3] 1 / Z is its product with (1, x, y).
        near: [n] bool: pixels that lie on it.
        error_per_m: standard deviation of their errors.
        gap_per_m: see `level_gap`.
    """

    normal: np.ndarray
    near: np.ndarray
    error_per_m: float
    gap_per_m: float


def _plane_of_three(
    design: np.ndarray, inverse: np.ndarray, rng: np.random.Generator
) -> np.ndarray | None:
    """The plane through three pixels drawn at random that most others are near, of many tries."""
    few = rng.choice(len(inverse), min(len(inverse), 4000), replace=False)
    best, normal = np.inf, None
    for _ in range(_TRIES):
        triple = rng.choice(few, 3, replace=False)
        if abs(np.linalg.det(design[triple])) < 1e-6:
            continue
        trial = np.linalg.solve(design[triple], inverse[triple])
        quantile = float(np.quantile(np.abs(design[few] @ trial - inverse[few]), 0.3))
        if quantile < best:
            best, normal = quantile, trial
    return normal


def _least_squares(normal: np.ndarray, design: np.ndarray, inverse: np.ndarray) -> _Fit:
    """Fit the plane near `normal`, and find anew what lies on it, until too little does."""
    near = np.abs(design @ normal - inverse) < _WIDE * inverse
    gap = scale = 0.0
    for _ in range(8):
        if near.sum() < _LEAST_PIXELS:
            break
        normal = np.linalg.lstsq(design[near], inverse[near], rcond=None)[0]
        error = np.abs(design @ normal - inverse)
        gap = level_gap(inverse[near])
        # Within one level errors say nothing, so the next levels count as well.
        scale = max(float(np.quantile(error[near], 0.68)), 0.6 * gap, 1e-7)
        near = error < np.minimum(4.5 * scale, 5 * _WIDE * inverse)
    return _Fit(normal, near, scale, gap)


def _view(
    normal: np.ndarray, camera: Intrinsics, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """[h, w] depth of the plane, inf where it is not in view, and angle of incidence in degrees."""
    height, width = shape
    u, v = np.arange(width), np.arange(height)[:, None]
    rx, ry = (u - camera.cx_px) / camera.focal_px, (v - camera.cy_px) / camera.focal_px
    along = normal[0] + normal[1] * rx + normal[2] * ry
    with np.errstate(divide="ignore"):
        plane = np.where(along > 0, 1 / along, np.inf)
    cosine = np.abs(along) / np.sqrt((rx**2 + ry**2 + 1) * (normal**2).sum())
    return plane, np.degrees(np.arccos(np.clip(cosine, 0, 1)))


def level_gap(inverse: np.ndarray) -> float:
    """Median gap between the distinct values of [N]; 0 where nearly every value is another."""
    levels, counts = np.unique(inverse.astype(np.float32), return_counts=True)
    if len(levels) > 0.05 * len(inverse):
        return 0.0
    levels = levels[counts >= max(3, 1e-4 * len(inverse))].astype(np.float64)
    return float(np.median(np.diff(levels))) if len(levels) > 1 else 0.0


def _centre(
    fit: _Fit, design: np.ndarray, error_per_m: np.ndarray, camera: Intrinsics
) -> tuple[float, float]:
    """Distance that is measured at the principal point on average, and its standard error.

    A camera with a bias, or a lens that bends, sees a plane bent: the plane alone is not what it
    measured in the middle. That is the mean of errors around that point (symmetric, or a slant
    would count as an error), which has few pixels: of noise that is smooth over many it holds more
    than the plane itself. So it counts from two standard errors on, and the more the larger it is
    (a garrote, Breiman 1995).

    Args:
        fit: the plane; its first coefficient is 1 / Z there.
        design: [N, 3] of the pixels that it was fitted to.
        error_per_m: [h, w] of 1 / Z from the plane, NaN where nothing was measured.
    """
    alone = _smooth_variance(error_per_m)
    of_plane = float(np.linalg.inv(design.T @ design)[0, 0])
    height, width = error_per_m.shape
    rows = np.abs(np.arange(height) - camera.cy_px) <= height // 10
    cols = np.abs(np.arange(width) - camera.cx_px) <= width // 10
    part = error_per_m[np.ix_(rows, cols)]
    part = part[np.isfinite(part)]
    inverse, variance = float(fit.normal[0]), alone * of_plane
    if part.size:
        mean, of_mean = float(part.mean()), 1 / part.size
        # The plane was fitted to these pixels, too: their errors from it are smaller by its own.
        own = alone * max(of_mean - of_plane, 0.0)
        counts = 1 - _BEND_SURE**2 * own / mean**2 if mean else 0.0
        if counts > 0:
            inverse += counts * mean
            variance = alone * max(of_mean, of_plane)
    distance = 1 / inverse
    # The mean of 1 / Z is that of a depth a little smaller than the mean.
    distance += float(np.nanvar(error_per_m)) * distance**3
    return distance, float(np.sqrt(variance)) * distance**2


def _smooth_variance(error: np.ndarray) -> float:
    """Variance of a mean over [h, w] errors with NaN, times their number.

    From second differences of means over patches in a row or a column, in which bends of the whole
    image are hardly seen. Where there are too few patches, that of single pixels.
    """
    parts = patches(error)
    count = np.isfinite(parts).sum(axis=(1, 3)).astype(float)
    means = np.nansum(parts, axis=(1, 3)) / np.maximum(count, 1)
    squares = []
    for m, n in ((means, count), (means.T, count.T)):
        least = np.minimum(np.minimum(n[:-2], n[1:-1]), n[2:])
        full = least > PATCH_PX**2 / 2
        second = m[:-2] - 2 * m[1:-1] + m[2:]
        # 1 + 4 + 1 variances of means over so many pixels each.
        of_one = 1 / n[:-2][full] + 4 / n[1:-1][full] + 1 / n[2:][full]
        squares.append(second[full] ** 2 / of_one)
    found = np.concatenate(squares)
    if len(found) < 10:
        return float(np.nanvar(error))
    return float(found.mean())


def patches(image: np.ndarray, side_px: int = PATCH_PX) -> np.ndarray:
    """[rows, side_px, columns, side_px] view of the patches that lie wholly in [h, w]."""
    rows, columns = (n // side_px for n in image.shape)
    part = image[: rows * side_px, : columns * side_px]
    return part.reshape(rows, side_px, columns, side_px)


def between(mask: np.ndarray) -> np.ndarray:
    """[h, w] bool: between the first and the last True of [h, w], in its row and its column."""
    out = np.ones_like(mask)
    for axis in (0, 1):
        before = np.logical_or.accumulate(mask, axis=axis)
        after = np.flip(np.logical_or.accumulate(np.flip(mask, axis), axis=axis), axis)
        out &= before & after
    return out


def _region(on_wall: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """[h, w] bool: the wall with its holes, of whatever size these are.

    What lies between pixels of the wall, in its row and in its column, but for a rim, where
    holes would be open to one side and left out. Holes next to another thing are its shadow.
    """
    inside = between(on_wall)
    side = 2 * (on_wall.shape[1] // _RIM) + 1
    kernel = np.ones((side, side), np.uint8)
    inside = cv2.erode(
        inside.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=(0.0,)
    ).astype(bool)
    holes = inside & ~measured
    _, number, stats, _ = cv2.connectedComponentsWithStats(
        (measured & ~on_wall).astype(np.uint8), connectivity=8
    )
    things = np.isin(number, 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= _LEAST_THING))
    if things.any():
        side = 2 * (on_wall.shape[1] // _SHADOW) + 1
        near = cv2.dilate(things.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        _, number = cv2.connectedComponents((holes & near).astype(np.uint8), connectivity=8)
        touching = cv2.dilate(things.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        holes &= ~np.isin(number, np.setdiff1d(number[touching & holes], 0))
    return (on_wall & inside) | holes
