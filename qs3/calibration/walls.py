"""How a camera measures a flat wall: its noise, its steps of depth and its bias.

A plane is linear in 1 / Z over the pixels of an image, so all fits are linear and their errors are
those of a disparity.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import nnls

from qs3.errors import DataError
from qs3.geometry.cameras import Intrinsics

_WIDE = 0.02  # of 1 / Z, relative: what the first fit takes for the wall
_LEAST_PIXELS = 2000
_LEAST_PURE = 0.6  # share of the depths within the outline of the wall that lie on it
_CLOSE_PX = 15  # holes up to this width are inside the outline
_BIN = 1.08  # ratio of the ends of a bin of distances
_LEAST_IN_BIN = 400
_FACING_DEG = 50.0  # noise is measured at smaller angles of incidence
_LEAST_RANGE = 1.3  # of distances, to tell one law from another
_RESOLUTIONS_M = (0.01, 0.001, 0.0001)
_MAX_TRIALS = 20_000
_CLEAR = 0.75  # mean resultant length of the levels' phases that is a lattice
# Standard deviation of a normal variable without its outer 2 x 0.5 %, relative to the whole:
# sqrt(1 - 2 a phi(a) / 0.99) with a = 2.5758.
_TRIMMED_NORMAL = 0.9616


@dataclass(frozen=True, eq=False)
class Wall:
    """The dominant plane of one depth image.

    Attributes:
        depth_m: [h, w] measured, NaN where nothing was or where something else is.
        plane_m: [h, w] depth of the fitted plane.
        error_per_m: [h, w] measured 1 / Z less a cubic surface, which holds the bend of the lens;
            NaN where `depth_m` is.
        tilt_deg: [h, w] angle of incidence on the plane.
        centre_m: distance at the principal point.
        fill: share of the pixels within the outline of the wall that have a depth.
    """

    depth_m: np.ndarray
    plane_m: np.ndarray
    error_per_m: np.ndarray
    tilt_deg: np.ndarray
    centre_m: float
    fill: float


def find_wall(name: str, depth_m: np.ndarray, camera: Intrinsics) -> Wall:
    """Fit the plane that most pixels of `depth_m` [h, w] with NaN lie on.

    Random triples first (the one with the lowest 30 % quantile of errors), then least squares on
    what lies within 4.5 standard deviations, eight times. No plane that covers most of what it
    surrounds is a DataError.
    """
    seen = np.isfinite(depth_m)
    rows, cols = np.nonzero(seen)
    if len(rows) < _LEAST_PIXELS:
        raise DataError(f"{name}: only {len(rows)} pixels have a depth")
    x = (cols - camera.cx_px) / camera.focal_px
    y = (rows - camera.cy_px) / camera.focal_px
    design = np.stack([np.ones_like(x), x, y], axis=1)
    inverse = 1 / depth_m[rows, cols]
    normal = _plane_of_three(design, inverse, np.random.default_rng(0))
    near = np.abs(design @ normal - inverse) < _WIDE * inverse
    for _ in range(8):
        if near.sum() < _LEAST_PIXELS:
            raise DataError(f"{name}: too few pixels lie on one plane, expected a flat wall")
        normal = np.linalg.lstsq(design[near], inverse[near], rcond=None)[0]
        error = np.abs(design @ normal - inverse)
        # Within one level of depth errors mean nothing, so the next levels count as well.
        scale = max(float(np.quantile(error[near], 0.68)), 0.6 * _level_gap(inverse[near]), 1e-7)
        near = error < np.minimum(4.5 * scale, 5 * _WIDE * inverse)
    on_wall = np.zeros(depth_m.shape, dtype=bool)
    on_wall[rows[near], cols[near]] = True
    kernel = np.ones((_CLOSE_PX, _CLOSE_PX), np.uint8)
    outline = cv2.morphologyEx(on_wall.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    if on_wall.sum() < _LEAST_PURE * ((outline > 0) & seen).sum():
        raise DataError(f"{name}: most pixels around the best plane are off it, not a flat wall")
    inside = cv2.erode(outline, kernel) > 0
    fill = float(on_wall[inside].mean()) if inside.any() else 1.0
    measured = np.where(on_wall, depth_m, np.nan)
    plane, tilt = _view(normal, camera, depth_m.shape)
    error_per_m = 1 / measured
    v, u = rows[near] / depth_m.shape[0] - 0.5, cols[near] / depth_m.shape[1] - 0.5
    basis = np.stack([u**i * v**j for i in range(4) for j in range(4 - i)], axis=1)
    bent = np.linalg.lstsq(basis, inverse[near], rcond=None)[0]
    error_per_m[rows[near], cols[near]] -= basis @ bent
    # The mean of 1 / Z is that of a depth a little smaller than the mean.
    centre = 1 / float(normal[0])
    centre += float(np.nanvar(error_per_m)) * centre**3
    return Wall(measured, plane, error_per_m, tilt, centre, fill)


def _plane_of_three(
    design: np.ndarray, inverse: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """The plane through three random pixels that most others are near, of many tries."""
    few = rng.choice(len(inverse), min(len(inverse), 4000), replace=False)
    design_of_few, inverse_of_few = design[few], inverse[few]
    best, normal = np.inf, np.array([float(np.median(inverse)), 0.0, 0.0])
    for _ in range(300):
        triple = rng.choice(few, 3, replace=False)
        if abs(np.linalg.det(design[triple])) < 1e-6:
            continue
        trial = np.linalg.solve(design[triple], inverse[triple])
        quantile = float(np.quantile(np.abs(design_of_few @ trial - inverse_of_few), 0.3))
        if quantile < best:
            best, normal = quantile, trial
    return normal


def _level_gap(inverse: np.ndarray) -> float:
    """Median gap between the distinct values of [N]; 0 where nearly every value is another."""
    levels, counts = np.unique(inverse.astype(np.float32), return_counts=True)
    if len(levels) > 0.05 * len(inverse):
        return 0.0
    levels = levels[counts >= max(3, 1e-4 * len(inverse))].astype(np.float64)
    return float(np.median(np.diff(levels))) if len(levels) > 1 else 0.0


def _view(
    normal: np.ndarray, camera: Intrinsics, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """[h, w] depth of the plane, inf where it is not in view, and angle of incidence in degrees."""
    u, v = np.arange(shape[1]), np.arange(shape[0])[:, None]
    rx, ry = (u - camera.cx_px) / camera.focal_px, (v - camera.cy_px) / camera.focal_px
    along = normal[0] + normal[1] * rx + normal[2] * ry
    with np.errstate(divide="ignore"):
        plane = np.where(along > 0, 1 / along, np.inf)
    cosine = np.abs(along) / np.sqrt((rx**2 + ry**2 + 1) * (normal**2).sum())
    return plane, np.degrees(np.arccos(np.clip(cosine, 0, 1)))


@dataclass(frozen=True)
class Steps:
    """Steps of Z in metres and of 1 / Z in 1/m; 0 where there are none."""

    depth_m: float = 0.0
    inverse_per_m: float = 0.0

    def rounding_per_m(self, depth_m: np.ndarray | float) -> np.ndarray | float:
        """Standard deviation of the error of 1 / Z that rounding to the steps makes."""
        return np.hypot(self.depth_m / depth_m**2, self.inverse_per_m) / np.sqrt(12)


def find_steps(walls: Sequence[Wall]) -> Steps:
    """Steps of all measured depths."""
    depths = np.concatenate([wall.depth_m[np.isfinite(wall.depth_m)] for wall in walls])
    some = depths[:: max(1, len(depths) // 50_000)]
    resolution = next((step for step in _RESOLUTIONS_M if _are_multiples(some, step)), 0.0)
    rounded = np.rint(depths / resolution) * resolution if resolution else depths
    levels, counts = np.unique(rounded.astype(np.float32), return_counts=True)
    if not resolution and len(levels) > 0.2 * len(depths):
        return Steps()
    strong = counts >= max(2, 2e-6 * len(depths))
    levels = levels[strong].astype(np.float64)
    weight = np.sqrt(np.minimum(counts[strong], 100))  # each level is one witness
    return Steps(resolution, _lattice(1 / levels, weight, resolution / levels**2))


def _are_multiples(depth_m: np.ndarray, step: float) -> bool:
    phase = depth_m / step
    return bool((np.abs(phase - np.rint(phase)) < 0.002 + 3e-7 * phase).mean() > 0.999)


def _lattice(x: np.ndarray, weight: np.ndarray, blur: np.ndarray) -> float:
    """Step of the lattice that levels `x` [N] of 1 / Z lie on; 0 if there is none.

    At the right step the phases of all levels are the same: the largest resultant wins, and of
    those nearly as large the coarsest step, because every fraction of it fits, too. `blur` [N] is
    the width of the interval in which rounding in the file moves each level.
    """
    gaps = np.abs(np.diff(x))
    wide = (gaps > 1.5 * blur[1:]) & (gaps < 8 * np.median(gaps))  # not those between walls
    if wide.sum() < max(8, 0.1 * len(gaps)):
        return 0.0
    finest = max(0.4 * float(np.quantile(gaps[wide], 0.1)), 1.5 * float(blur.min()))
    coarsest = 2.2 * float(np.quantile(gaps[wide], 0.75))
    if not 0 < finest < coarsest:
        return 0.0
    trials = int(min(_MAX_TRIALS, 12 * np.ptp(x) * (1 / finest - 1 / coarsest) + 50))
    frequency = np.linspace(1 / coarsest, 1 / finest, trials)
    score = np.array([_resultant(x, weight, blur, each) for each in frequency])
    if score.max() < _CLEAR:
        return 0.0
    best = int(np.argmax(score > 0.97 * score.max()))
    best = max(range(max(0, best - 12), min(trials, best + 13)), key=lambda i: score[i])
    step = 1 / frequency[best]
    offset = np.angle((weight * np.exp(2j * np.pi * x / step)).sum()) / (2 * np.pi) * step
    for _ in range(4):  # least squares over the whole numbers
        index = np.rint((x - offset) / step)
        good = np.abs(x - offset - step * index) < 0.4 * step
        step, offset = np.polyfit(index[good], x[good], 1, w=np.sqrt(weight[good]))
    return float(step)


def _resultant(x: np.ndarray, weight: np.ndarray, blur: np.ndarray, frequency: float) -> float:
    """Length of the mean phase, 0..1; 0 if it is within what chance makes of so few levels."""
    known = np.where(frequency * blur < 0.8, np.sinc(frequency * blur), 0)
    use = known * weight
    if not use.any():
        return 0.0
    total = np.abs((use * np.exp(2j * np.pi * frequency * x)).sum())
    length = min(float(total / (use * known).sum()), 1.0)
    number = float(use.sum() ** 2 / (use**2).sum())
    # Rayleigh: exp(-n R^2) is the chance that phases without a lattice do as well.
    return length if number * length**2 > 12 else 0.0


@dataclass(frozen=True, eq=False)
class Noise:
    """The law sigma(Z) = floor_m + factor Z^power before the quantiser.

    Attributes:
        correlation_px: standard deviation of the Gaussian that smooths the noise.
        depth_m, sigma_m: [n] what was measured, without what rounding adds.
    """

    floor_m: float
    factor: float
    power: float
    correlation_px: float
    depth_m: np.ndarray
    sigma_m: np.ndarray


def find_noise(walls: Sequence[Wall], steps: Steps) -> Noise:
    """Noise against distance, from the inner 99 % of the errors in bins of distance.

    Its power is 1 or 2, what fits better; 2 where all walls are about equally far.
    """
    bins = []
    for wall in walls:
        usable = np.isfinite(wall.depth_m) & (wall.tilt_deg < _FACING_DEG)
        z, error = wall.plane_m[usable], wall.error_per_m[usable]
        number = np.floor(np.log(z) / np.log(_BIN)).astype(int)
        for each in np.unique(number):
            inside = number == each
            depth = float(z[inside].mean())
            near, far = np.quantile(error[inside], [0.005, 0.995])
            inner = error[inside & (error >= near) & (error <= far)]
            variance = inner.var() / _TRIMMED_NORMAL**2 - steps.rounding_per_m(depth) ** 2
            if inside.sum() >= _LEAST_IN_BIN and variance > 0:
                bins.append((depth, np.sqrt(variance) * depth**2, np.sqrt(inside.sum())))
    if not bins:
        raise DataError("no noise is seen beside the steps of depth; turn the camera a little")
    z, sigma, weight = np.array(bins).T
    several, laws = z.max() / z.min() >= _LEAST_RANGE, []
    for each in (1.0, 2.0) if several else (2.0,):
        # Relative least squares with floor and factor >= 0.
        design = np.stack([several * np.ones_like(z), z**each], axis=1)
        (floor, factor), misfit = nnls(design * (weight / sigma)[:, None], weight)
        laws.append((misfit, float(floor), float(factor), each))
    return Noise(*min(laws)[1:], _correlation_px(walls, steps), z, sigma)


def _correlation_px(walls: Sequence[Wall], steps: Steps) -> float:
    """Standard deviation s of the Gaussian that smooths the noise.

    Pixels n apart have the correlation exp(-n^2 / 4 s^2); at n = 1 and 2 rounding adds nothing.
    """
    near = far = variance = 0.0
    for wall in walls:
        for image in (wall.error_per_m, wall.error_per_m.T):
            near += float(np.nanmean(image[:, 1:] * image[:, :-1]))
            far += float(np.nanmean(image[:, 2:] * image[:, :-2]))
            variance += float(np.nanvar(image) - steps.rounding_per_m(wall.centre_m) ** 2)
    if not 0.1 * variance < near or not 0 < far < near:
        return 0.0
    return float(np.sqrt(0.75 / np.log(near / far)))


def find_bias(walls: Sequence[Wall], distances_m: Sequence[float]) -> tuple[float, ...]:
    """Polynomial of the error of the distance, the constant first: a line from three walls on."""
    true = np.array(distances_m, dtype=float)
    error = np.array([wall.centre_m for wall in walls]) - true
    line = len(walls) > 2 and true.max() / true.min() > _LEAST_RANGE
    return tuple(float(c) for c in np.polynomial.polynomial.polyfit(true, error, int(line)))
