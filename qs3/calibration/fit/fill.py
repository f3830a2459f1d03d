"""What walls say of a camera's holes: how many at which angle of incidence, and of what size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from qs3.calibration.fit.planes import PATCH_PX, Wall, patches
from qs3.sensors.devices.fitted import neighbour_correlation

_SPAN_DEG = 5.0  # between the knots that are tried
_LEAST_IN_SPAN = 2000
_LEAST_HOLES = 400
_PATCH_HOLES = 12  # holes' sizes that a patch is wide, or holes would lie in several
_ROUNDS = 3  # of weights: the last two lead to the same knots
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
    data ask for (Schwarz 1978; holes count, not pixels, see `_together`): a mean over 5 degrees is
    too low or too high at a bend, and a knot that chance alone moves says nothing of the camera.
    """
    tilt = np.concatenate([wall.tilt_deg[wall.region] for wall in walls])
    valid = np.concatenate([np.isfinite(wall.depth_m[wall.region]) for wall in walls]).astype(float)
    pixels = np.bincount(_span(tilt))
    covered = np.flatnonzero(pixels >= _LEAST_IN_SPAN)
    hole_px = _hole_size(walls)
    inside = np.isin(_span(tilt), covered)
    if not inside.any():
        return Fill((float(tilt.mean()),), (float(valid.mean()),), hole_px)
    seen_deg, seen_rates = (
        tuple(float(x) for x in np.bincount(_span(tilt), values)[covered] / pixels[covered])
        for values in (tilt, valid)
    )
    lines = _Lines(_knots(tilt[inside], covered), tilt[inside], valid[inside])
    kept, rates = lines.fewest(_together(walls, lines, covered, hole_px))
    return Fill(
        tuple(map(float, kept)),
        tuple(map(float, np.clip(rates, 0, 1))),
        hole_px,
        seen_deg,
        seen_rates,
    )


def _span(tilt: np.ndarray) -> np.ndarray:
    """Number of the span of 5 degrees that angles lie in."""
    return np.floor(tilt / _SPAN_DEG).astype(int)


def _knots(tilt: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """[K] degrees: where spans meet, and the first and last angle of each row of spans.

    No knot lies where nothing was seen: its rate would be a line drawn on into the blue.
    """
    found = []
    for row in np.split(covered, np.flatnonzero(np.diff(covered) > 1) + 1):
        own = tilt[np.isin(_span(tilt), row)]
        found.append(np.clip(np.append(row, row[-1] + 1) * _SPAN_DEG, own.min(), own.max()))
    return np.unique(np.concatenate(found))


class _Lines:
    """Weighted least squares of lines between knots, for any of the knots.

    A pixel weighs as the inverse of its variance. Lines between some of the knots are sums of
    those between all, so the pixels are looked at once for all of them.

    Args:
        knots: [K] degrees, ascending, around all of `tilt`.
        tilt, valid: [N] degrees; 1 with a depth, 0 without.
    """

    def __init__(self, knots: np.ndarray, tilt: np.ndarray, valid: np.ndarray) -> None:
        self.knots, self.tilt, self.valid = knots, tilt, valid
        count = len(knots)
        self.left = np.clip(np.searchsorted(knots, tilt, side="right") - 1, 0, max(count - 2, 0))
        widths = np.diff(knots) if count > 1 else np.ones(1)
        self.share = (tilt - knots[self.left]) / widths[self.left]
        self._sum(np.ones_like(tilt))
        self.rates, _ = self._solved(np.eye(count))

    def fewest(self, together: float) -> tuple[np.ndarray, np.ndarray]:
        """Knots that are kept, and rates there; a single one is at the mean angle.

        The knot that is needed least goes, down to none, and of these laws the one counts whose
        misfit and price are least; the price of a knot is the logarithm of how many holes there
        might be, which is `together` times less than pixels. Pixels weigh by the law that the round
        before found, the first by none: weights of rates that chance made would favour it.
        """
        pixels = len(self.tilt)
        price = together * np.log(max(pixels / together, 2.0))
        rates: np.ndarray = np.full(len(self.tilt), self.valid.mean())
        for _ in range(_ROUNDS):
            rate = np.clip(rates, *_CERTAIN)
            self._sum(1 / (rate * (1 - rate)))
            kept, found = self._cheapest(price)
            rates = np.interp(self.tilt, kept, found)
        return kept, found

    def variance(self, tilt: np.ndarray) -> np.ndarray:
        """Of one pixel at an angle, by the rates of all knots."""
        rate = np.clip(self.at(tilt), *_CERTAIN)
        return np.asarray(rate * (1 - rate))

    def at(self, tilt: np.ndarray) -> np.ndarray:
        """Rates with all knots."""
        return np.interp(tilt, self.knots, self.rates)

    def _cheapest(self, price: float) -> tuple[np.ndarray, np.ndarray]:
        mean, misfit = self._solved(np.ones((len(self.knots), 1)))
        best, least = (np.array([self.middle]), mean), misfit + price
        kept = np.arange(len(self.knots))
        while len(kept) > 1:
            rates, misfit = self._solved(self._between(kept))
            if misfit + price * len(kept) < least:
                best, least = (self.knots[kept], rates), misfit + price * len(kept)
            fewer = [np.delete(kept, i) for i in range(1, len(kept) - 1)]
            if not fewer:
                break
            kept = min(fewer, key=lambda some: self._solved(self._between(some))[1])
        return best

    def _sum(self, weight: np.ndarray) -> None:
        """The normal equations' matrix [K, K], right-hand side [K] and constant."""
        count, left, share, valid = len(self.knots), self.left, self.share, self.valid

        def summed(values: np.ndarray) -> np.ndarray:
            return np.bincount(left, weight * values, minlength=count)

        # What a pixel gives the knot on its left, and, one on, the knot on its right.
        own = summed((1 - share) ** 2) + np.roll(summed(share**2), 1)
        beside = np.diag(summed(share * (1 - share))[:-1], 1)
        self.matrix = np.diag(own) + beside + beside.T
        self.side = summed((1 - share) * valid) + np.roll(summed(share * valid), 1)
        self.constant = float((weight * valid**2).sum())
        self.middle = float((weight * self.tilt).sum() / weight.sum())

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


def _together(walls: Sequence[Wall], lines: _Lines, covered: np.ndarray, hole_px: float) -> float:
    """How many pixels are a hole or not as one: 1 or more.

    By how much the number of holes in patches of the image varies, over by how much it would if
    pixels were independent. Patches are at most a third of an image: holes of more than a 40th of
    it reach beyond them, and are taken for more than they are.
    """
    varied = expected = 0.0
    for wall in walls:
        side = min(max(PATCH_PX, round(_PATCH_HOLES * hole_px)), min(wall.region.shape) // 3)
        inside = wall.region & np.isin(_span(wall.tilt_deg), covered)
        error = np.where(inside, np.isfinite(wall.depth_m) - lines.at(wall.tilt_deg), 0.0)
        alone = np.where(inside, lines.variance(wall.tilt_deg), 0.0)
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
