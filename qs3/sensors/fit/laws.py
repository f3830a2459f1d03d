"""What walls say about a camera: noise, step, bias, fill."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from qs3.errors import DataError
from qs3.sensors.fit.planes import Wall
from qs3.sensors.fit.steps import Steps
from qs3.sensors.fitted import neighbour_correlation

TRIMMED_NORMAL = 0.9616
"""Standard deviation of a normal law without its lowest and highest 0.5 %."""
_BIN = 1.08  # ratio of the ends of a bin of distances
_LEAST_IN_BIN = 400
_FACING_DEG = 50.0  # noise against distance is taken from smaller tilts
_LEAST_RANGE = 1.3  # of distances, to tell one law from another


@dataclass(frozen=True, eq=False)
class Noise:
    """sigma(Z) = floor + factor Z^power before the quantiser.

    Attributes:
        floor_m, factor, power: of the law.
        depth_m, sigma_m: [n] what was measured, quantiser included.
        power_known: whether the distances differ enough to tell the power.
        correlation_px: see FittedDepth.
    """

    floor_m: float
    factor: float
    power: float
    depth_m: np.ndarray
    sigma_m: np.ndarray
    power_known: bool
    correlation_px: float

    def law_m(self, depth_m: np.ndarray) -> np.ndarray:
        """sigma(Z)."""
        return self.floor_m + self.factor * depth_m**self.power


@dataclass(frozen=True)
class Fill:
    """Share of valid pixels against the angle of incidence.

    Attributes:
        tilts_deg, rates: see FittedDepth.
        hole_px: size of the holes.
    """

    tilts_deg: tuple[float, ...]
    rates: tuple[float, ...]
    hole_px: float


def find_noise(walls: Sequence[Wall], steps: Steps, power: float | None = None) -> Noise:
    """Noise against distance.

    Pixels are binned by the plane's depth, frame by frame; sigma is the standard deviation of
    the inner 99 %. The quantiser's share, step^2 / 12, is taken off before the law is fitted.

    Args:
        power: 1 or 2 to fix the law; None lets the data choose, if distances differ by 30 %.

    Raises:
        DataError: too few pixels.
    """
    depth, sigma, white = [], [], []
    for wall in walls:
        usable = wall.on_wall & (wall.tilt_deg < _FACING_DEG)
        if not usable.any():
            usable = wall.on_wall
        z, error = wall.plane_m[usable], (wall.depth_m - wall.plane_m)[usable]
        bins = np.floor(np.log(z) / np.log(_BIN)).astype(int)
        for number in np.unique(bins):
            inside = bins == number
            if inside.sum() < _LEAST_IN_BIN:
                continue
            part = error[inside]
            low, high = np.quantile(part, [0.005, 0.995])
            depth.append(float(z[inside].mean()))
            sigma.append(float(part[(part >= low) & (part <= high)].std()) / TRIMMED_NORMAL)
            white.append(inside.sum())
    if not depth:
        raise DataError("too few pixels lie on the wall to measure noise: 400 at one distance")
    z, total, weight = np.array(depth), np.array(sigma), np.sqrt(np.array(white, dtype=float))
    quantiser = (steps.inverse_per_m * z**2) ** 2 / 12 + steps.depth_m**2 / 12
    some = total > 0  # a quiet camera may see one level only
    if not some.any():
        raise DataError(
            "every wall has one single level of depth: turn the camera by a few degrees, so that "
            "several steps are seen"
        )
    z, total, weight, quantiser = (a[some] for a in (z, total, weight, quantiser))
    bare = np.sqrt(np.maximum(total**2 - quantiser, (0.05 * total) ** 2))
    known = power is not None or z.max() / z.min() > _LEAST_RANGE
    if not known:
        factor = float((weight * bare / z**2).sum() / weight.sum())
        floor, chosen = 0.0, 2.0
    else:
        laws = [_law(z, bare, weight, p) for p in ((1.0, 2.0) if power is None else (power,))]
        _, floor, factor, chosen = min(laws)
    correlation = _correlation(walls, steps)
    return Noise(floor, factor, chosen, z, total, known, correlation)


def _law(
    z: np.ndarray, sigma: np.ndarray, weight: np.ndarray, power: float
) -> tuple[float, float, float, float]:
    """Misfit, floor, factor, power; relative least squares with floor and factor >= 0."""
    from scipy.optimize import nnls

    design = np.stack([np.ones_like(z), z**power], axis=1) * (weight / sigma)[:, None]
    (floor, factor), misfit = nnls(design, weight)
    return float(misfit), float(floor), float(factor), power


def _correlation(walls: Sequence[Wall], steps: Steps) -> float:
    """Size of the Gaussian that explains the correlation of horizontal neighbours.

    In 1 / Z where the steps are, because noise and rounding have one size there. Rounding has a
    variance of step^2 / 12 and, where noise exceeds a third of a step, hardly a correlation.
    """
    products, squares = [], []
    for wall in walls:
        if steps.inverse_per_m:
            error = 1 / wall.depth_m - 1 / wall.plane_m
            rounding = steps.inverse_per_m**2 / 12
        else:
            error = (wall.depth_m - wall.plane_m) / wall.plane_m
            rounding = steps.depth_m**2 / 12 / wall.centre_m**2
        error = np.where(wall.on_wall, error, np.nan)
        variance = float(np.nanvar(error))
        products.append(float(np.nanmean(error[:, 1:] * error[:, :-1])) / variance)
        squares.append(1 - min(rounding / variance, 0.9))
    wanted = float(np.mean(products)) / float(np.mean(squares))
    if wanted < 0.1:
        return 0.0
    sizes = np.linspace(0.2, 10, 197)
    found = np.array([neighbour_correlation(size) for size in sizes])
    return float(np.interp(min(wanted, found[-1]), found, sizes))


def find_fill(walls: Sequence[Wall]) -> Fill:
    """Share of the wall's pixels that have a depth, by angle of incidence in bins of 5 degrees."""
    tilt = np.concatenate([wall.tilt_deg[wall.region] for wall in walls])
    valid = np.concatenate([np.isfinite(wall.depth_m[wall.region]) for wall in walls])
    bins = np.floor(tilt / 5).astype(int)
    tilts, rates = [], []
    for number in np.unique(bins):
        inside = bins == number
        if inside.sum() >= 2000:
            tilts.append(float(tilt[inside].mean()))
            rates.append(float(valid[inside].mean()))
    if not tilts:
        tilts, rates = [float(tilt.mean())], [float(valid.mean())]
    return Fill(tuple(tilts), tuple(rates), _hole_size(walls))


def _hole_size(walls: Sequence[Wall]) -> float:
    """From the mean length of holes along rows: single pixels give 0."""
    lengths = []
    for wall in walls:
        hole = wall.region & ~np.isfinite(wall.depth_m)
        edges = np.diff(np.pad(hole, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        starts, ends = (np.argwhere(edges == sign) for sign in (1, -1))
        lengths.append(ends[:, 1] - starts[:, 1])
    runs = np.concatenate(lengths)
    mean = float(runs.mean()) if len(runs) else 1.0
    return 0.0 if mean < 1.3 else min(mean / 2, 10.0)


def find_bias(walls: Sequence[Wall], distances_m: Sequence[float] | None) -> tuple[float, ...]:
    """Polynomial of the error of the plane's distance in the middle; (0,) without references."""
    if distances_m is None:
        return (0.0,)
    tilt = np.array([float(np.median(wall.tilt_deg[wall.region])) for wall in walls])
    facing = tilt < _FACING_DEG / 2
    use = facing if facing.any() else np.ones_like(facing)
    true = np.array(distances_m)[use]
    error = np.array([wall.centre_m for wall in walls])[use] - true
    degree = min(len(np.unique(true)) - 1, 2)
    return tuple(float(c) for c in np.polynomial.polynomial.polyfit(true, error, degree))
