"""What walls say of a camera's holes: how many at which angle of incidence, and of what size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from qs3.sensors.devices.fitted import neighbour_correlation
from qs3.sensors.fit.planes import PATCH_PX, Wall, patches

_SPAN_DEG = 5.0  # between the knots that are tried
_LEAST_IN_SPAN = 2000
_LEAST_HOLES = 400
_PATCH_HOLES = 12  # holes' sizes that a patch is wide, or holes would lie in several
_CERTAIN = (0.01, 0.99)  # no pixel counts more than one at these rates


@dataclass(frozen=True)
class Fill:
    """Share of valid pixels against the angle of incidence.

    Attributes:
        tilts_deg, rates: see FittedDepth.
        hole_px: size of the holes.
        seen_deg, seen_rates: what was measured, in spans of 5 degrees.
    """

    tilts_deg: tuple[float, ...]
    rates: tuple[float, ...]
    hole_px: float
    seen_deg: tuple[float, ...] = ()
    seen_rates: tuple[float, ...] = ()


def find_fill(walls: Sequence[Wall]) -> Fill:
    """Share of the wall's pixels that have a depth, by angle of incidence.

    Lines between knots at multiples of 5 degrees, by least squares, of which as few are kept as the
    data allow (Schwarz 1978; holes count, not pixels, see `_together`): a mean over 5 degrees is
    too low or too high at a bend, and a knot that chance alone moves says nothing of the camera.
    """
    tilt = np.concatenate([wall.tilt_deg[wall.region] for wall in walls])
    valid = np.concatenate([np.isfinite(wall.depth_m[wall.region]) for wall in walls]).astype(float)
    spans = np.floor(tilt / _SPAN_DEG).astype(int)
    pixels = np.bincount(spans)
    covered = np.flatnonzero(pixels >= _LEAST_IN_SPAN)
    hole_px = _hole_size(walls)
    inside = np.isin(spans, covered)
    edges = np.union1d(covered, covered + 1) * _SPAN_DEG
    if not inside.any() or np.ptp(tilt[inside]) == 0:
        return Fill((float(tilt.mean()),), (float(valid.mean()),), hole_px)
    seen_deg, seen_rates = (
        tuple(float(x) for x in np.bincount(spans, values)[covered] / pixels[covered])
        for values in (tilt, valid)
    )
    tilt, valid = tilt[inside], valid[inside]
    lines = _Lines(np.unique(np.clip(edges, tilt.min(), tilt.max())), tilt, valid)
    kept, rates = lines.fewest(_together(walls, lines, hole_px))
    return Fill(
        tuple(map(float, kept)),
        tuple(map(float, np.clip(rates, 0, 1))),
        hole_px,
        seen_deg,
        seen_rates,
    )


class _Lines:
    """Weighted least squares of lines between knots, for any of the knots.

    A pixel weighs as the inverse of its variance. Lines between some of the knots are sums of
    those between all, so the pixels are looked at once.

    Args:
        knots: [K] degrees, ascending, around all of `tilt`.
        tilt, valid: [N] degrees; 1 with a depth, 0 without.
    """

    def __init__(self, knots: np.ndarray, tilt: np.ndarray, valid: np.ndarray) -> None:
        self.knots, self.pixels = knots, len(tilt)
        self.weight = np.ones_like(tilt)
        for _ in range(2):  # all alike first: the variance is that of the rates found
            self._sum(tilt, valid)
            self.rates = self._solved(np.eye(len(knots)))[0]
            self.weight = 1 / self.variance(tilt)
        self._sum(tilt, valid)

    def variance(self, tilt: np.ndarray) -> np.ndarray:
        """Of one pixel at an angle."""
        rate = np.clip(self.at(tilt), *_CERTAIN)
        return np.asarray(rate * (1 - rate))

    def at(self, tilt: np.ndarray) -> np.ndarray:
        """Rates with all knots."""
        return np.interp(tilt, self.knots, self.rates)

    def fewest(self, together: float) -> tuple[np.ndarray, np.ndarray]:
        """Knots that are kept, and rates there; a single one is the mean of all pixels.

        The knot that is needed least goes, as long as the misfit grows by less than the logarithm
        of the number of holes that may be or not, which is `together` times smaller than that of
        the pixels.
        """
        price = together * np.log(max(self.pixels / together, 2.0))
        kept = np.arange(len(self.knots))
        rates, misfit = self._solved(self._between(kept))
        while len(kept) > 2:
            tried = [
                (self._solved(self._between(np.delete(kept, i))), i)
                for i in range(1, len(kept) - 1)
            ]
            (fewer, more), i = min(tried, key=lambda one: one[0][1])
            if more - misfit > price:
                break
            kept, rates, misfit = np.delete(kept, i), fewer, more
        if len(kept) == 2:
            mean, more = self._solved(np.ones((len(self.knots), 1)))
            if more - misfit <= price:
                return np.array([self.middle]), mean
        return self.knots[kept], rates

    def _sum(self, tilt: np.ndarray, valid: np.ndarray) -> None:
        """The normal equations' matrix [K, K], right-hand side [K] and constant."""
        count = len(self.knots)
        left = np.clip(np.searchsorted(self.knots, tilt, side="right") - 1, 0, count - 2)
        share = (tilt - self.knots[left]) / np.diff(self.knots)[left]
        sums = [
            np.bincount(left, self.weight * values, minlength=count)
            for values in ((1 - share) ** 2, share**2, share * (1 - share))
        ]
        self.matrix = np.diag(sums[0] + np.roll(sums[1], 1))
        off = np.diag(sums[2][:-1], 1)
        self.matrix += off + off.T
        self.side = np.bincount(left, self.weight * (1 - share) * valid, minlength=count)
        self.side += np.bincount(left + 1, self.weight * share * valid, minlength=count)
        self.constant = float((self.weight * valid**2).sum())
        self.middle = float((self.weight * tilt).sum() / self.weight.sum())

    def _between(self, kept: np.ndarray) -> np.ndarray:
        """[K, k] values at all knots of lines between those that are kept."""
        return np.stack(
            [np.interp(self.knots, self.knots[kept], row) for row in np.eye(len(kept))], axis=1
        )

    def _solved(self, basis: np.ndarray) -> tuple[np.ndarray, float]:
        """Coefficients [k] of a basis [K, k], and the weighted sum of squared errors."""
        side = basis.T @ self.side
        found = np.linalg.lstsq(basis.T @ self.matrix @ basis, side, rcond=None)[0]
        return found, self.constant - float(side @ found)


def _together(walls: Sequence[Wall], lines: _Lines, hole_px: float) -> float:
    """How many pixels are a hole or not as one: 1 or more.

    By how much the number of holes in patches of the image varies, over by how much it would if
    pixels were independent.
    """
    varied = expected = 0.0
    for wall in walls:
        side = min(max(PATCH_PX, round(_PATCH_HOLES * hole_px)), min(wall.region.shape) // 3)
        error = np.where(wall.region, np.isfinite(wall.depth_m) - lines.at(wall.tilt_deg), 0.0)
        alone = np.where(wall.region, lines.variance(wall.tilt_deg), 0.0)
        varied += float((patches(error, side).sum(axis=(1, 3)) ** 2).sum())
        expected += float(patches(alone, side).sum())
    return max(1.0, varied / expected) if expected else 1.0


def _hole_size(walls: Sequence[Wall]) -> float:
    """The Gaussian that explains how often horizontal neighbours are both without a depth.

    Holes are where a smooth normal field exceeds what the fill rate allows.
    """
    # Correlations of neighbours from 0 to nearly 1, and the probability that both exceed.
    grid = np.concatenate([np.linspace(0, 0.95, 96), 1 - np.geomspace(0.045, 1e-4, 60)])
    wanted, expected = [], []
    for wall in walls:
        hole = wall.region & ~np.isfinite(wall.depth_m)
        pair = wall.region[:, 1:] & wall.region[:, :-1]
        share = float(hole.sum() / max(wall.region.sum(), 1))
        if hole.sum() < _LEAST_HOLES or share > 0.95:
            continue
        wanted.append(float((hole[:, 1:] & hole[:, :-1])[pair].mean()))
        density = np.exp(-(ndtri(share) ** 2) / (1 + grid)) / np.sqrt(1 - grid**2) / (2 * np.pi)
        steps = np.diff(grid) * (density[1:] + density[:-1]) / 2
        expected.append(share**2 + np.concatenate([[0], np.cumsum(steps)]))
    if not wanted:
        return 0.0
    misfit = np.abs(np.mean(expected, axis=0) - np.mean(wanted))
    correlation = float(grid[int(np.argmin(misfit))])
    if correlation < 0.1:
        return 0.0
    sizes = np.linspace(0.2, 20, 397)
    found = np.array([neighbour_correlation(size) for size in sizes])
    return float(np.interp(min(correlation, found[-1]), found, sizes))
