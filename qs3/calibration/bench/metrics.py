"""What is measured on a depth image, as librealsense's depth-quality tool defines it.

tools/depth-quality/rs-depth-quality.cpp: fill rate is the share of valid pixels in the region
looked at; the nearest and farthest 0.5 % of the points are dropped and a plane is fitted;
plane-fit RMS is that of the distances to it, sub-pixel RMS that of f B / Z - f B / Z_plane, and
Z accuracy the median of the signed error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

TRIM = 0.005

TRIMMED_NORMAL = 0.9616
"""Standard deviation of a normal variable without its outer 2 x 0.5 %, relative to the whole:
sqrt(1 - 2 a phi(a) / 0.99) with a = 2.5758."""


def trimmed(values: np.ndarray, share: float = TRIM) -> np.ndarray:
    """[N] -> the same without the lowest and the highest `share`, sorted."""
    values = np.sort(values[np.isfinite(values)], axis=None)
    cut = int(len(values) * share)
    return values[cut : len(values) - cut]


def rms(values: np.ndarray) -> float:
    """Root of the mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("nan")


def median(values: np.ndarray) -> float:
    """Median; NaN of nothing."""
    return float(np.median(values)) if values.size else float("nan")


@dataclass(frozen=True)
class PlaneFit:
    """What a plane fitted to one depth image says.

    Attributes:
        rms_m: of the points' distances to the plane.
        subpixel_rms_px: of f B / Z - f B / Z_plane; NaN without a baseline.
        points: how many were used.
        inverse: [3] (a, b, c) of 1 / Z = a x + b y + c with x, y = tangents of a pixel's ray.
    """

    rms_m: float
    subpixel_rms_px: float
    points: int
    inverse: np.ndarray


def fit_plane(
    depth_m: np.ndarray, x: np.ndarray, y: np.ndarray, focal_baseline: float | None
) -> PlaneFit:
    """Total least squares through [N] points of a depth image.

    Args:
        depth_m: metres along the optical axis, finite.
        x, y: tangents of the rays, (u - cx) / f and (v - cy) / f.
        focal_baseline: f B in px m; None for sensors that do not triangulate.
    """
    if len(depth_m) < 10:
        nothing = float("nan")
        return PlaneFit(nothing, nothing, len(depth_m), np.full(3, nothing))
    order = np.argsort(depth_m, kind="stable")
    cut = int(len(order) * TRIM)
    keep = order[cut : len(order) - cut]
    z, x, y = (np.asarray(a, dtype=np.float64)[keep] for a in (depth_m, x, y))
    points = np.stack([x * z, y * z, z], axis=1)
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    distance = (points - centre) @ normal
    # n . (x, y, 1) Z = n . centre, so 1 / Z is linear in x and y.
    inverse = normal / (normal @ centre)
    subpixel = float("nan")
    if focal_baseline is not None:
        plane = inverse[0] * x + inverse[1] * y + inverse[2]
        subpixel = rms(focal_baseline * (1 / z - plane))
    return PlaneFit(rms(distance), subpixel, len(z), inverse)


def power_law(depth_m: np.ndarray, sigma_m: np.ndarray) -> tuple[float, float]:
    """Exponent p and factor a of sigma = a Z^p, by least squares on the logarithms."""
    good = np.isfinite(sigma_m) & (sigma_m > 0)
    if good.sum() < 2:
        return float("nan"), float("nan")
    p, log_a = np.polyfit(np.log(depth_m[good]), np.log(sigma_m[good]), 1)
    return float(p), float(np.exp(log_a))


def levels(disparity_px: np.ndarray) -> np.ndarray:
    """The distinct values in [N] disparities, told apart at 1/1024 px, ascending."""
    return np.unique(np.rint(disparity_px * 1024)) / 1024


def expected_levels(low_px: float, high_px: float, steps_per_px: int, offset_px: float) -> int:
    """How many steps k / steps_per_px + offset_px lie in [low_px, high_px]."""
    first = np.ceil((low_px - offset_px) * steps_per_px - 1e-6)
    last = np.floor((high_px - offset_px) * steps_per_px + 1e-6)
    return int(max(0, last - first + 1))


def locking_px(phase: np.ndarray, error_px: np.ndarray) -> float:
    """Amplitude of the first harmonic of the error of the disparity over its sub-pixel phase.

    `phase` [N] is the fraction of the true disparity, 0..1, spread evenly; `error_px` [N] may be
    NaN.
    """
    good = np.isfinite(error_px)
    if good.sum() < 4:
        return float("nan")
    angle = 2 * np.pi * phase[good]
    basis = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    found = np.linalg.lstsq(basis, error_px[good], rcond=None)[0]
    return float(np.hypot(found[1], found[2]))


def correlation_px(residuals: Sequence[np.ndarray]) -> float:
    """Over how many pixels noise is shared: where its correlation has fallen to one half.

    `residuals` are [h, w] with NaN and mean 0; rows and columns of all are pooled, and the
    correlation is interpolated between whole pixels. NaN if it does not fall so far.
    """
    before = 1.0
    power = np.concatenate([image.ravel() ** 2 for image in residuals])
    if not np.isfinite(power).any():
        return float("nan")
    variance = float(np.nanmean(power))
    longest = min(min(image.shape) for image in residuals) - 1
    for lag in range(1, longest + 1):
        pairs = []
        for image in residuals:
            pairs += [image[:, lag:] * image[:, :-lag], image[lag:] * image[:-lag]]
        products = np.concatenate([pair.ravel() for pair in pairs])
        if not np.isfinite(products).any():
            break
        here = float(np.nanmean(products)) / max(variance, 1e-30)
        if here <= 0.5:
            return lag - 1 + (before - 0.5) / (before - here)
        before = here
    return float("nan")


def runs(mask: np.ndarray) -> np.ndarray:
    """Lengths of the runs of True along the rows of [h, w] bool, row by row."""
    padded = np.pad(mask.astype(np.int8), ((0, 0), (1, 1)))
    change = np.diff(padded, axis=1)
    starts, ends = np.nonzero(change == 1), np.nonzero(change == -1)
    return ends[1] - starts[1]
