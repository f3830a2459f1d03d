"""The steps in which a device gives depths: of one size in 1 / Z, of one size in Z, or none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from qs3.calibration.fit.frames import DepthImage

_MAX_LEVELS = 3000
_MAX_TRIALS = 60_000
_CLEAR = 0.75
"""Mean resultant length of the levels' phases from which a lattice counts as found."""


@dataclass(frozen=True, eq=False)
class Steps:
    """What was found.

    Attributes:
        depth_m: step of Z, of the device or of its files; 0 if there is none.
        levels_m: [N] the distinct depths, ascending; empty where depths are continuous.
        inverse_per_m: step of 1 / Z in 1/m; 0 if there is none.
        offset_per_m: 1 / Z is this plus a whole number of steps.
        misfit: RMS distance of 1 / Z from the steps, in steps; 0.29 would be no steps at all.
    """

    depth_m: float
    levels_m: np.ndarray
    inverse_per_m: float = 0.0
    offset_per_m: float = 0.0
    misfit: float = 0.29

    def interval(self, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Between which values of 1 / Z the measured one lay before it was rounded."""
        inverse = 1 / depth_m
        if self.inverse_per_m:
            index = np.rint((inverse - self.offset_per_m) / self.inverse_per_m)
            return tuple(
                (index + side) * self.inverse_per_m + self.offset_per_m for side in (-0.5, 0.5)
            )
        half = self.depth_m / 2
        return 1 / (depth_m + half), 1 / np.maximum(depth_m - half, 1e-3)

    def rounding_m(self, depth_m: np.ndarray) -> np.ndarray:
        """Standard deviation of the error of Z that rounding to the steps makes."""
        inverse = self.inverse_per_m * depth_m**2
        return np.asarray(np.sqrt((inverse**2 + self.depth_m**2) / 12))


def find_steps(frames: Sequence[DepthImage]) -> Steps:
    """Look for steps in all depths of some frames."""
    resolution = min(frame.resolution_m for frame in frames)
    depths = np.concatenate([f.depth_m[np.isfinite(f.depth_m)] for f in frames])
    if resolution:
        whole, counts = np.unique(np.rint(depths / resolution).astype(np.int64), return_counts=True)
        levels = whole * resolution
    else:
        levels, counts = np.unique(depths.astype(np.float32), return_counts=True)
        levels = levels.astype(np.float64)
    if not resolution and len(levels) > 0.2 * len(depths):
        return Steps(0.0, np.zeros(0))
    strong = counts >= max(2, 2e-6 * len(depths))
    levels, counts = levels[strong], counts[strong]
    if len(levels) < 4:
        return Steps(resolution, levels)
    weight = np.sqrt(np.minimum(counts, 100))  # each level is one witness
    # A level is known to half a unit of the file: dx = r / Z^2 / 2 to either side.
    found = _lattice((1 / levels)[::-1], weight[::-1], resolution / levels[::-1] ** 2)
    if found is not None:
        return Steps(resolution, levels, *found)
    if resolution:
        coarser = _multiple(np.rint(levels / resolution).astype(np.int64), counts)
        return Steps(coarser * resolution, levels)
    found = _lattice(levels, weight, np.zeros_like(levels))
    return Steps(0.0 if found is None else found[0], levels)


def _multiple(whole: np.ndarray, counts: np.ndarray) -> int:
    """The largest m of which nearly all of [N] whole numbers are multiples."""
    total = counts.sum()
    for m in range(min(100, int(whole.max())), 1, -1):
        if counts[whole % m == 0].sum() > 0.995 * total:
            return m
    return 1


def _lattice(
    x: np.ndarray, weight: np.ndarray, blur: np.ndarray
) -> tuple[float, float, float] | None:
    """Step, offset in [0, step) and RMS misfit in steps of the levels' lattice, if there is one.

    The levels' phases at a trial step are as one if it is right: the largest resultant wins, and of
    those as large the coarsest step.

    Args:
        x: [N] levels, ascending.
        weight: [N] how much each counts.
        blur: [N] width of the interval in which each is uniform, from rounding in the file.
    """
    if len(x) > _MAX_LEVELS:
        keep = np.linspace(0, len(x) - 1, _MAX_LEVELS).astype(int)  # trims nothing of the range
        x, weight, blur = x[keep], weight[keep], blur[keep]
    gaps = np.diff(x)
    wide = gaps > 1.5 * blur[1:]
    wide &= gaps < 8 * np.median(gaps)  # not those between walls
    if wide.sum() < max(3, 0.1 * len(gaps)):
        return None
    few = _few(x, weight, blur)
    if few is not None:
        return few
    # The finest step that could be told from rounding, and one that is surely too coarse.
    finest = max(0.4 * float(np.quantile(gaps[wide], 0.1)), 1.5 * float(blur.min()))
    coarsest = 2.2 * float(np.quantile(gaps[wide], 0.75))
    if not 0 < finest < coarsest:
        return None
    span = x[-1] - x[0]
    trials = int(min(_MAX_TRIALS, 12 * span * (1 / finest - 1 / coarsest) + 50))
    frequency = np.linspace(1 / coarsest, 1 / finest, trials)
    score, clear = np.zeros(trials), np.zeros(trials, dtype=bool)
    for first in range(0, trials, 512):
        part = slice(first, first + 512)
        score[part], clear[part] = _resultant(x, weight, blur, frequency[part], np.log(trials))
    score[~clear] = 0
    if not clear.any():
        return None
    # Every fraction of the right step fits nearly as well.
    best = int(np.argmax(score > 0.97 * score.max()))
    near = slice(max(0, best - 12), best + 13)
    best = near.start + int(np.argmax(score[near]))
    step = 1 / frequency[best]
    phase = np.exp(2j * np.pi * x / step)
    use = weight * np.clip(1 - blur / step, 0, None)
    offset = float(np.angle((use * phase).sum())) / (2 * np.pi) * step
    for _ in range(4):  # least squares over the whole numbers
        index = np.rint((x - offset) / step)
        off = x - offset - step * index
        good = (np.abs(off) < 0.5 * step * 0.8) & (use > 0)
        design = np.stack([index[good], np.ones(good.sum())], axis=1)
        root = np.sqrt(use[good])[:, None]
        if len(np.unique(index[good])) < 3:
            return None
        (step, offset), *_ = np.linalg.lstsq(design * root, x[good] * root[:, 0], rcond=None)
        use = weight * np.clip(1 - blur / step, 0, None)
    off = (x - offset) / step
    off -= np.rint(off)
    misfit = float(np.sqrt((use * off**2).sum() / use.sum()))
    return float(step), float(offset % step), misfit


def _few(x: np.ndarray, weight: np.ndarray, blur: np.ndarray) -> tuple[float, float, float] | None:
    """Step, offset and misfit where some walls show two or three levels each, else None.

    So few levels lie on many lattices; but gaps that are alike at different depths are enough.
    """
    gaps, known = np.diff(x), (blur[1:] + blur[:-1]) / 2
    near = gaps < 8 * gaps.min()
    if len(x) > 40 or near.sum() < 3 or (known[near] > 0.2 * gaps[near]).any():
        return None
    where = x[1:][near]
    if where.max() < 1.3 * where.min():  # a step of Z would look the same
        return None
    times = np.rint(gaps[near] / gaps[near].min())
    step = float((gaps[near] * times).sum() / (times**2).sum())
    if (np.abs(gaps[near] - times * step) > 0.02 * step * times + known[near]).any():
        return None
    # The step is known to a part of a gap only: too little to count steps from wall to wall.
    angle = np.angle((weight * np.exp(2j * np.pi * x / step)).sum())
    return step, float(angle / (2 * np.pi) * step % step), float("nan")


def _resultant(
    x: np.ndarray, weight: np.ndarray, blur: np.ndarray, frequency: np.ndarray, chance: float
) -> tuple[np.ndarray, np.ndarray]:
    """[F] resultant lengths, and whether each is clear and beyond chance."""
    known = np.clip(np.sinc(np.outer(frequency, blur)), 0, None)
    known[np.outer(frequency, blur) > 0.8] = 0
    use = known * weight
    total = np.maximum(use.sum(axis=1), 1e-12)
    length = np.abs((use * np.exp(2j * np.pi * np.outer(frequency, x))).sum(axis=1)) / total
    # Rounding in the file shortens the resultant by the same factor again.
    expected = np.maximum((use * known).sum(axis=1) / total, 1e-12)
    number = total**2 / np.maximum((use**2).sum(axis=1), 1e-12)
    length = np.minimum(length / expected, 1)
    # Rayleigh: exp(-n R^2) is the chance that phases without a lattice do as well.
    return length, (length > _CLEAR) & (number * length**2 > chance + 5)
