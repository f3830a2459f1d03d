"""Noise of depths that were rounded: what lay between two steps is known to lie there, no more."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import ndtr

from qs3.calibration.fit.planes import PATCH_PX, Wall, patches
from qs3.calibration.fit.steps import Steps

_MAX_PIXELS = 12_000
_OUTLIERS = 1e-4  # share of pixels that lie anywhere, so that a single one decides nothing
_COARSE = 0.5  # steps a standard deviation from which rounding is not a small extra error


def smooth_wall(wall: Wall, steps: Steps) -> np.ndarray:
    """[h, w] 1 / Z of the wall as the camera sees it without noise: a cubic in the pixels.

    Lenses bend a plane over the whole image, which is not noise. Where steps are coarse the
    surface is that of highest likelihood (every pixel gives an interval, the error is normal),
    because a mean over few steps is drawn to them.
    """
    height, width = wall.depth_m.shape
    rows, cols = np.nonzero(wall.on_wall)
    basis = cubic_basis(rows / height - 0.5, cols / width - 0.5)
    y = 1 / wall.depth_m[rows, cols]
    found = np.linalg.lstsq(basis, y, rcond=None)[0]
    v, u = np.mgrid[:height, :width]
    everywhere = cubic_basis(v.ravel() / height - 0.5, u.ravel() / width - 0.5)
    low, high = steps.interval(wall.depth_m[rows, cols])
    step, spread = float(np.median(high - low)), float(np.std(basis @ found - y))
    if step > _COARSE * spread:
        some = np.linspace(0, len(y) - 1, min(len(y), _MAX_PIXELS)).astype(int)
        found = _most_likely(basis[some], low[some], high[some], found, step, spread)
    return np.asarray(everywhere @ found).reshape(height, width)


def spread_between(low: np.ndarray, high: np.ndarray, mean: np.ndarray) -> float:
    """Standard deviation of normal errors about `mean` of values known to lie in [low, high]."""
    step = float(np.median(high - low))
    total = inner_spread((low + high) / 2 - mean)
    if step < _COARSE * total:
        return float(np.sqrt(max(total**2 - step**2 / 12, 0.0)))

    def cost(log_sigma: float) -> float:
        sigma = np.exp(log_sigma)
        share = ndtr((high - mean) / sigma) - ndtr((low - mean) / sigma)
        return -float(np.log((1 - _OUTLIERS) * share + _OUTLIERS).mean())

    ends = (np.log(0.02 * step), np.log(3 * max(step, total)))
    return float(np.exp(minimize_scalar(cost, bounds=ends, method="bounded").x))


def share_together(wall: Wall, surface: np.ndarray, steps: Steps) -> float:
    """Share of the errors' variance that means over blocks of the image have; 0 to 1.

    Errors are those that rounding to the steps cannot make; `surface` [h, w] is 1 / Z without
    noise. 0 where they are smaller than half a step: rounding alone is even over patches.
    """
    low, high = steps.interval(wall.depth_m)
    error = np.maximum(low - surface, 0) - np.maximum(surface - high, 0)
    error = np.where(wall.on_wall, error, np.nan)
    whole = float(np.nanvar(error))
    if whole == 0 or np.sqrt(whole) < 0.5 * float(np.nanmedian(high - low)):
        return 0.0
    parts = patches(error)
    count = np.isfinite(parts).sum(axis=(1, 3))
    full = count > PATCH_PX**2 / 2
    if full.sum() < 10:
        return 0.0
    means = np.nansum(parts, axis=(1, 3))[full] / count[full]
    centre = np.average(means, weights=count[full])
    return min(1.0, float(np.average((means - centre) ** 2, weights=count[full])) / whole)


TRIMMED_NORMAL = 0.9616
"""Standard deviation of a normal law without its lowest and highest 0.5 %."""


def inner_spread(values: np.ndarray) -> float:
    """Standard deviation of a normal law, from the inner 99 % of [N] values."""
    near, far = np.quantile(values, [0.005, 0.995])
    return float(values[(values >= near) & (values <= far)].std()) / TRIMMED_NORMAL


def cubic_basis(v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """[N, 10] monomials up to the third degree."""
    return np.stack([u**i * v**j for i in range(4) for j in range(4 - i)], axis=1)


def _most_likely(
    basis: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    start: np.ndarray,
    step: float,
    spread: float,
) -> np.ndarray:
    """Coefficients of the surface from which normal errors lead into the intervals."""
    q, r = np.linalg.qr(basis)
    q, r = q * np.sqrt(len(q)), r / np.sqrt(len(q))
    below, above = low / step, high / step
    first = np.append(
        r @ start / step, np.log(max(np.sqrt(max((spread / step) ** 2 - 1 / 12, 0)), 0.1))
    )

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        sigma, mean = np.exp(x[-1]), q @ x[:-1]
        a, b = (below - mean) / sigma, (above - mean) / sigma
        share = (1 - _OUTLIERS) * (ndtr(b) - ndtr(a)) + _OUTLIERS
        pa, pb = (np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi) for t in (a, b))
        by_mean = (pb - pa) / sigma / share
        by_sigma = (b * pb - a * pa) / share
        return -float(np.log(share).mean()), np.append(q.T @ by_mean, by_sigma.sum()) / len(q)

    bounds = [(None, None)] * len(start) + [(np.log(0.02), np.log(10.0))]
    found = minimize(cost, first, jac=True, method="L-BFGS-B", bounds=bounds).x[:-1]
    return np.asarray(np.linalg.solve(r, found) * step)
