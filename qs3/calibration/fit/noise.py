"""What walls say of a camera's noise: how it grows with the distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from qs3.calibration.fit.planes import Wall
from qs3.calibration.fit.rounded import inner_spread, share_together, smooth_wall, spread_between
from qs3.calibration.fit.steps import Steps
from qs3.calibration.fit.texture import noise_size_px
from qs3.errors import DataError
from qs3.sensors.devices.fitted import FittedDepth

_BIN = 1.08  # ratio of the ends of a bin of distances
_LEAST_IN_BIN = 400
_FACING_DEG = 50.0  # noise against distance is taken from smaller tilts
_TURN = (
    "every wall shows one level of depth, or a few of them, which says neither how large a step is "
    "nor what the noise is: turn the camera by a few degrees, so that many steps are seen"
)
_LEAST_RANGE = 1.3  # of distances, to tell one law from another


@dataclass(frozen=True, eq=False)
class Noise:
    """sigma(Z) = floor + factor Z^power before the quantiser.

    Attributes:
        floor_m, factor, power: of the law.
        depth_m, sigma_m: [n] what was measured, quantiser included.
        frame: [n] index of the wall that it was measured on.
        together: for each wall, see `share_together`.
        power_known: whether the distances differ enough to tell the power.
        correlation_px: see FittedDepth.
    """

    floor_m: float
    factor: float
    power: float
    depth_m: np.ndarray
    sigma_m: np.ndarray
    frame: np.ndarray
    together: tuple[float, ...]
    power_known: bool
    correlation_px: float

    def law_m(self, depth_m: np.ndarray) -> np.ndarray:
        """sigma(Z)."""
        return self.floor_m + self.factor * depth_m**self.power


def find_noise(walls: Sequence[Wall], steps: Steps, power: float | None = None) -> Noise:
    """Noise against distance.

    Pixels are binned by the plane's depth, frame by frame. Errors are those from a smooth surface
    (`smooth_wall`), so that neither distortion nor bias counts as noise. sigma as measured is the
    standard deviation of the inner 99 %; that before the quantiser, to which the law is fitted, is
    the one of highest likelihood (`spread_between`). `power` 1 or 2 fixes the law; None lets the
    data choose, if distances differ by 30 %.

    Raises:
        DataError: too few pixels.
    """
    if not steps.inverse_per_m and all(_few_levels(wall, steps) for wall in walls):
        raise DataError(_TURN)
    bins: list[_Bin] = []
    together, hidden = [], False
    for index, wall in enumerate(walls):
        surface = smooth_wall(wall, steps)
        together.append(share_together(wall, surface, steps))
        found = _bins(index, wall, surface, steps)
        hidden |= found is None
        bins += found or []
    if not bins and not hidden:
        raise DataError("too few pixels lie on the wall to measure noise: 400 at one distance")
    bins = [one for one in bins if one.before_m > 0]  # a quiet camera may see one level only
    if not bins:
        raise DataError(_TURN)
    z = np.array([one.depth_m for one in bins])
    known = power is not None or float(z.max() / z.min()) > _LEAST_RANGE
    floor, factor, chosen = _fitted_law(bins, power) if known else _parabola(bins)

    def simulated(size_px: float) -> FittedDepth:
        return FittedDepth(
            min_depth_m=1e-3,
            max_depth_m=1e3,
            noise_floor_m=floor,
            noise_factor=factor,
            noise_power=chosen,
            correlation_px=size_px,
            inverse_step_per_m=steps.inverse_per_m,
            depth_step_m=steps.depth_m,
        )

    return Noise(
        floor,
        factor,
        chosen,
        z,
        np.array([one.sigma_m for one in bins]),
        np.array([one.frame for one in bins]),
        tuple(together),
        known,
        noise_size_px(walls, simulated),
    )


class _Bin(NamedTuple):
    """Pixels of one wall at about one distance.

    Attributes:
        frame: index of the wall.
        depth_m: mean distance.
        sigma_m: of the errors, quantiser included.
        before_m: that before the quantiser; 0 where a single level is seen.
        pixels: how many.
    """

    frame: int
    depth_m: float
    sigma_m: float
    before_m: float
    pixels: int


def _bins(frame: int, wall: Wall, surface: np.ndarray, steps: Steps) -> list[_Bin] | None:
    """Errors from the `surface` by distance; None if rounding hides them (`_within_a_step`)."""
    usable = wall.on_wall & (wall.tilt_deg < _FACING_DEG)
    if not usable.any():
        usable = wall.on_wall
    z, mean, measured = wall.plane_m[usable], surface[usable], wall.depth_m[usable]
    if _within_a_step(1 / z, 1 / measured - mean, wall.gap_per_m):
        return None
    low, high = steps.interval(measured)
    numbers = np.floor(np.log(z) / np.log(_BIN)).astype(int)
    found = []
    for number in np.unique(numbers):
        inside = numbers == number
        pixels = int(inside.sum())
        if pixels < _LEAST_IN_BIN:
            continue
        depth = float(z[inside].mean())
        sigma = inner_spread(measured[inside] - 1 / mean[inside])
        # A single level says nothing of what lies below a step.
        levels = len(np.unique(measured[inside].astype(np.float32)))
        spread = spread_between(low[inside], high[inside], mean[inside]) if levels > 1 else 0.0
        found.append(_Bin(frame, depth, sigma, spread * depth**2, pixels))
    return found


def _fitted_law(bins: Sequence[_Bin], power: float | None) -> tuple[float, float, float]:
    """Floor, factor and power of the law that fits best, or of `power`."""
    z, sigma, weight = _columns(bins)
    laws = [_law(z, sigma, weight, p) for p in ((1.0, 2.0) if power is None else (power,))]
    _, floor, factor, chosen = min(laws)
    return floor, factor, chosen


def _parabola(bins: Sequence[_Bin]) -> tuple[float, float, float]:
    """Floor, factor and power where distances do not tell the law: factor Z^2."""
    z, sigma, weight = _columns(bins)
    return 0.0, float((weight * sigma / z**2).sum() / weight.sum()), 2.0


def _columns(bins: Sequence[_Bin]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance, sigma before the quantiser, and weight of each bin."""
    z, sigma, pixels = (
        np.array([getattr(one, name) for one in bins], dtype=float)
        for name in ("depth_m", "before_m", "pixels")
    )
    return z, sigma, np.sqrt(pixels)


def _within_a_step(inverse: np.ndarray, error: np.ndarray, gap: float) -> bool:
    """Whether a wall meets so few steps that rounding is not spread evenly, and noise is small.

    Over many steps rounding adds step^2 / 12 to the variance, whatever the noise; over few only
    if the noise is half a step or more.

    Args:
        inverse, error: [N] 1 / Z of the plane, and errors of 1 / Z.
        gap: between levels of 1 / Z.
    """
    low, high = np.quantile(inverse, [0.05, 0.95])
    return gap > 0 and high - low < 2 * gap and float(error.std()) < 0.55 * gap


def _few_levels(wall: Wall, steps: Steps) -> bool:
    """Whether depths come in a few levels, further apart than the steps that were found."""
    levels = np.unique(wall.depth_m[wall.on_wall].astype(np.float32))
    if len(levels) >= 8:
        return False
    return len(levels) < 2 or float(np.median(np.diff(levels))) > 1.5 * steps.depth_m


def _law(
    z: np.ndarray, sigma: np.ndarray, weight: np.ndarray, power: float
) -> tuple[float, float, float, float]:
    """Misfit, floor, factor, power; relative least squares with floor and factor >= 0."""
    from scipy.optimize import nnls

    design = np.stack([np.ones_like(z), z**power], axis=1) * (weight / sigma)[:, None]
    (floor, factor), misfit = nnls(design, weight)
    return float(misfit), float(floor), float(factor), power
