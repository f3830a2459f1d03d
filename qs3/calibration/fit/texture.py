"""How far noise reaches over neighbouring pixels: what fits when it is simulated.

A quantiser and the removal of a smooth surface change the correlation of neighbours. So the sensor
is simulated on the plane that was found, its image is treated like the camera's, and
the size is taken whose correlations over the first pixels are nearest to the camera's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from qs3.calibration.fit.planes import Wall
from qs3.calibration.fit.rounded import cubic_basis
from qs3.sensors.devices.fitted import FittedDepth

_WALLS = 3  # so many of the least slanted are used
_HEIGHT_PX, _WIDTH_PX = 180, 240  # and so much of each
_LAGS = 12
_SIZES = (0.0, *np.geomspace(0.3, 12.0, 14))


def noise_size_px(walls: Sequence[Wall], simulated: Callable[[float], FittedDepth]) -> float:
    """Size of the Gaussian that smooths the noise of a camera's walls.

    `simulated` gives the fitted sensor with noise of a size, without holes.
    """
    cuts = [_cut(wall) for wall in _facing(walls)]

    def of(wall: Wall, depth_m: np.ndarray) -> np.ndarray:
        where = wall.on_wall & np.isfinite(depth_m)
        with np.errstate(divide="ignore"):
            error = 1 / depth_m - 1 / wall.plane_m
        return _correlations(_flattened(error, where), _LAGS)

    wanted = [of(wall, wall.depth_m) for wall in cuts]

    def misfit(size_px: float) -> float:
        sensor = simulated(size_px)
        rng = np.random.default_rng(0)
        found = [of(wall, _measured(sensor, wall, rng)) for wall in cuts]
        return float(sum(np.nansum((a - b) ** 2) for a, b in zip(wanted, found, strict=True)))

    return _best(misfit)


def _facing(walls: Sequence[Wall]) -> list[Wall]:
    return sorted(walls, key=lambda wall: float(np.median(wall.tilt_deg[wall.region])))[:_WALLS]


def _cut(wall: Wall) -> Wall:
    """The part around the middle of the wall."""
    rows, cols = np.nonzero(wall.region)
    spans = []
    for at, size, limit in (
        (float(np.median(rows)), wall.region.shape[0], _HEIGHT_PX),
        (float(np.median(cols)), wall.region.shape[1], _WIDTH_PX),
    ):
        first = int(min(max(0.0, at - limit / 2), max(0, size - limit)))
        spans.append(slice(first, first + limit))
    images = ("depth_m", "plane_m", "tilt_deg", "region")
    return replace(wall, **{name: getattr(wall, name)[tuple(spans)] for name in images})


def _measured(sensor: FittedDepth, wall: Wall, rng: np.random.Generator) -> np.ndarray:
    cosine = np.cos(np.deg2rad(wall.tilt_deg))
    return sensor.measure(wall.plane_m, cosine, rng)[0].astype(np.float64)


def _flattened(error: np.ndarray, where: np.ndarray) -> np.ndarray:
    """[h, w] error without its smooth part, a cubic surface: the lens's, not noise. NaN outside."""
    height, width = error.shape
    x = np.broadcast_to(np.linspace(-1, 1, width), error.shape)[where]
    y = np.broadcast_to(np.linspace(-1, 1, height)[:, None], error.shape)[where]
    design = cubic_basis(y, x)
    out = np.full(error.shape, np.nan)
    if len(x) < 2 * design.shape[1]:
        return out
    values = error[where]
    out[where] = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    return out


def _correlations(values: np.ndarray, lags: int) -> np.ndarray:
    """[2 lags] of [h, w] with NaN: along rows, then along columns, relative to the variance."""
    variance = np.nanmean(values**2) if np.isfinite(values).any() else 0.0
    if variance == 0:
        return np.full(2 * lags, np.nan)
    out = []
    for image in (values, values.T):
        for lag in range(1, lags + 1):
            pairs = image[:, lag:] * image[:, :-lag]
            good = np.isfinite(pairs)
            out.append(pairs[good].mean() / variance if good.any() else np.nan)
    return np.array(out)


def _best(misfit: Callable[[float], float]) -> float:
    """The size with the least misfit: of a coarse row of sizes, then between its neighbours."""
    from scipy.optimize import minimize_scalar

    found = [misfit(size) for size in _SIZES]
    best = int(np.argmin(found))
    if _SIZES[best] <= 0.3:  # a narrower Gaussian leaves white noise white
        return 0.0
    low, high = _SIZES[best - 1], _SIZES[min(best + 1, len(_SIZES) - 1)]
    return float(
        minimize_scalar(misfit, bounds=(low, high), method="bounded", options={"xatol": 0.02}).x
    )
