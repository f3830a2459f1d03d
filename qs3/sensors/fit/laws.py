"""What walls say about a camera: noise, step, bias, fill."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from qs3.errors import DataError
from qs3.sensors.fit.planes import Wall
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
class Steps:
    """The quantiser; 0 where there is none.

    Attributes:
        inverse_per_m: step of 1 / Z.
        depth_m: step of Z.
        coherence: how well the levels lie on the grid, 0..1.
    """

    inverse_per_m: float
    depth_m: float
    coherence: float


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


def find_steps(walls: Sequence[Wall], unit_m: float) -> Steps:
    """The step of the levels, constant in 1 / Z or in Z.

    The levels of a grid with step q have phases x / q that agree: the coherence is the length of
    their mean direction. Of the candidate steps that are coherent, the largest is the step:
    its halves and thirds are coherent too.
    """
    values = np.concatenate([wall.depth_m[wall.on_wall] for wall in walls])
    levels, counts = np.unique(np.round(values, 7), return_counts=True)
    if len(levels) > 0.3 * len(values) or len(levels) < 8:
        return Steps(0.0, 0.0, 0.0)
    levels = levels[counts >= 3]
    if len(levels) < 8:
        return Steps(0.0, 0.0, 0.0)
    if len(levels) > 600:
        levels = levels[:: len(levels) // 600 + 1]
    gap = float(np.median(np.diff(levels)))
    # Rounding to whole counts of the file blurs a grid in 1 / Z; it is one in Z itself.
    inverse, how_inverse = _grid(1 / levels[::-1], allowance=0.8)
    stored = abs(gap - unit_m) < 0.01 * unit_m and unit_m < 1
    if inverse and inverse * float(np.median(levels)) ** 2 > 1.5 * unit_m * (unit_m < 1):
        return Steps(inverse, unit_m if unit_m < 1 else 0.0, how_inverse)
    if stored:
        return Steps(0.0, unit_m, 1.0)
    depth, how_depth = _grid(levels, allowance=0.95)
    return Steps(0.0, depth, how_depth)


def _grid(levels: np.ndarray, allowance: float) -> tuple[float, float]:
    """Largest coherent step of increasing levels, 0 if there is none; and its coherence."""
    gaps = np.diff(levels)
    span = float(levels[-1] - levels[0])
    low, high = 0.3 * float(np.median(gaps)), 2.5 * float(np.quantile(gaps, 0.9))
    steps, step = [], low
    while step < high:
        steps.append(step)
        step += 0.12 * step * step / span
        if len(steps) > 200_000:
            return 0.0, 0.0
    candidates = np.array(steps)
    coherence = np.concatenate(
        [
            np.abs(np.exp(2j * np.pi * levels[:, None] / part).mean(axis=0))
            for part in np.array_split(candidates, max(1, len(candidates) // 2000))
        ]
    )
    top = float(coherence.max())
    if top < allowance:
        return 0.0, top
    good = np.flatnonzero(coherence > max(allowance, 0.93 * top))
    # The last run of good candidates is one peak: its best.
    start = good[-1]
    while start - 1 in good:
        start -= 1
    peak = start + int(coherence[start : good[-1] + 1].argmax())
    return float(candidates[peak]), float(coherence[peak])


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
    bare = np.sqrt(np.maximum(total**2 - quantiser, (0.05 * total) ** 2))
    known = power is not None or z.max() / z.min() > _LEAST_RANGE
    if not known:
        factor = float((weight * bare / z**2).sum() / weight.sum())
        floor, chosen = 0.0, 2.0
    else:
        laws = [_law(z, bare, weight, p) for p in ((1.0, 2.0) if power is None else (power,))]
        misfit, floor, factor, chosen = min(laws)
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
    """Size of the Gaussian that explains the correlation of horizontal neighbours."""
    products, squares, rounding = [], [], []
    for wall in walls:
        error = np.where(wall.on_wall, wall.depth_m - wall.plane_m, np.nan)
        scale = np.nanstd(error)
        error = np.clip(error, -3 * scale, 3 * scale) / scale
        pair = error[:, 1:] * error[:, :-1]
        products.append(float(np.nanmean(pair)))
        squares.append(float(np.nanmean(error**2)))
        z = np.where(wall.on_wall, wall.plane_m, np.nan)
        step = np.nanmean((steps.inverse_per_m * z**2) ** 2) / 12 + steps.depth_m**2 / 12
        rounding.append(float(step / scale**2))
    bare = float(np.mean(squares)) - min(float(np.mean(rounding)), 0.9)
    wanted = float(np.mean(products)) / max(bare, 1e-9)
    if wanted < 0.05:
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
    true = np.array(distances_m)
    error = np.array([wall.centre_m for wall in walls]) - true
    degree = min(len(np.unique(true)) - 1, 2)
    return tuple(float(c) for c in np.polynomial.polynomial.polyfit(true, error, degree))
