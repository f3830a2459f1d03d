"""What real Kinect v1 clouds show, and the same measured on simulated ones.

Depth steps, holes, the side of the shadow, and the noise of the table's plane; everything is
measured on a depth image alone, so that real and simulated ones are treated alike.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from qs3.calibration.bench import metrics
from qs3.calibration.fit.planes import between

FOCAL_PX = 525.0
"""Focal length of the published clouds: u - 319.5 = 525 x / z holds to 1e-5 px in all eight."""

FOCAL_BASELINE = 580.0 * 0.075
"""f B of the device's infrared camera (Konolige and Mihelich), px m."""


def read_cloud(path: Path) -> np.ndarray:
    """[480, 640] depth in metres with NaN of an organised cloud."""
    from qs3.datasets.clouds.pcd import read_pcd

    return np.asarray(read_pcd(path).image("z"), dtype=np.float32)


def statistics(depth_m: np.ndarray) -> tuple[dict[str, Any], np.ndarray]:
    """All that is measured on one depth image of a table.

    Args:
        depth_m: [h, w] metres with NaN, camera with FOCAL_PX and the principal point centred.

    Returns:
        Plain numbers by name, and [N] lengths in px of the holes along rows. The numbers:
        levels: distinct depths beyond 0.8 m, where a step is larger than the file's 1 mm.
        step_focal_baseline, step_residual: see `fit_steps`.
        level_use: see `uneven_levels`; 0 if all levels are used alike: the trace of pixel locking.
        table_rms_m, table_subpixel_px: see `table_noise`.
        holes: share of pixels without depth within the outline of what has depth.
        run_median_px, run_90_px: median and 90 % quantile of the holes' lengths.
        left_share: see `shadow_side`.
        mixed: share of the steps with a pixel between; see `depth_steps`. mixed_steps, steps: its
            counts.
    """
    flat = depth_m[np.isfinite(depth_m)].astype(np.float64)
    values = np.unique(np.rint(flat[flat > 0.8] * 1000)) / 1000
    fb, residual = fit_steps(values)
    rms_m, subpixel = table_noise(depth_m)
    inside = outline(depth_m)
    gaps = inside & ~np.isfinite(depth_m)
    runs = metrics.runs(gaps)
    mixed, steps = depth_steps(depth_m)
    return {
        "levels": len(values),
        "step_focal_baseline": fb,
        "step_residual": residual,
        "level_use": uneven_levels(flat[(flat > 0.8) & (flat < 1.3)], fb),
        "table_rms_m": rms_m,
        "table_subpixel_px": subpixel,
        "holes": float(gaps.sum() / max(inside.sum(), 1)),
        "run_median_px": metrics.median(runs),
        "run_90_px": float(np.quantile(runs, 0.9)) if runs.size else float("nan"),
        "left_share": shadow_side(depth_m, gaps),
        "mixed": mixed / steps if steps else float("nan"),
        "mixed_steps": mixed,
        "steps": steps,
    }, runs


def fit_steps(depths_m: np.ndarray, steps_per_px: int = 8) -> tuple[float, float]:
    """The f B in px m for which [N] distinct levels lie best on a grid of 1 / (steps f B) in 1 / Z.

    Returns:
        f B, and the RMS distance of the levels from the grid in steps (0.29 if there is none).
    """
    if len(depths_m) < 20:
        return float("nan"), float("nan")
    inverse = 1 / depths_m
    best = (np.inf, np.nan)
    for fb in np.arange(35.0, 55.0, 0.01):
        phase = inverse * fb * steps_per_px
        off = (phase - _offset(phase) + 0.5) % 1 - 0.5
        best = min(best, (metrics.rms(off), float(fb)))
    return best[1], best[0]


def _offset(phase: np.ndarray) -> float:
    """The free offset of a grid of whole numbers: the circular mean of the phases."""
    angle = 2 * np.pi * phase
    return float(np.arctan2(np.sin(angle).mean(), np.cos(angle).mean()) / (2 * np.pi))


def uneven_levels(depths_m: np.ndarray, focal_baseline: float, steps_per_px: int = 8) -> float:
    """Standard deviation of the relative use of the steps within a pixel.

    Each level's count is divided by the mean count of the pixel of disparity around it, and
    averaged over all levels with the same fraction of a pixel.
    """
    if not np.isfinite(focal_baseline) or not depths_m.size:
        return float("nan")
    phase = steps_per_px * focal_baseline / depths_m
    level = np.rint(phase - _offset(phase)).astype(int)
    counts = np.bincount(level - level.min()).astype(np.float64)
    around = np.convolve(counts, np.ones(steps_per_px) / steps_per_px, mode="same")
    inner = np.arange(steps_per_px, len(counts) - steps_per_px)
    inner = inner[around[inner] > 0]
    share = counts[inner] / around[inner]
    use = [share[inner % steps_per_px == i].mean() for i in range(steps_per_px)]
    return float(np.std(use))


def outline(depth_m: np.ndarray) -> np.ndarray:
    """[h, w] bool: between the first and the last pixel with a depth, in its row and its column.

    The outer 4 pixels are left out: there the cut of the table is ragged.
    """
    out = between(np.isfinite(depth_m))
    return cv2.erode(out.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0


def shadow_side(depth_m: np.ndarray, gaps: np.ndarray) -> float:
    """Share of the hole pixels between depths 3 cm apart or more that lie left of the nearer."""
    left_px = right_px = 0
    for row, line in zip(depth_m, gaps, strict=True):
        edges = np.flatnonzero(np.diff(np.pad(line.astype(np.int8), 1)))
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            if start == 0 or end == len(row):
                continue
            before, after = row[start - 1], row[end]
            if before - after > 0.03:
                left_px += end - start
            elif after - before > 0.03:
                right_px += end - start
    total = left_px + right_px
    return left_px / total if total else float("nan")


def depth_steps(depth_m: np.ndarray, step_m: float = 0.1, apart_m: float = 0.02) -> tuple[int, int]:
    """Steps in depth, along rows and columns: those with a pixel that lies between, and all.

    A step is two neighbours that differ by more than `step_m`, or two pixels that do with one
    between them that is farther than `apart_m` from both: a mixed or flying pixel.
    """
    steps = mixed = 0
    for depth in (depth_m, depth_m.T):
        first, middle, last = depth[:, :-2], depth[:, 1:-1], depth[:, 2:]
        low, high = np.minimum(first, last), np.maximum(first, last)
        with np.errstate(invalid="ignore"):
            between = (high - low > step_m) & (middle > low + apart_m) & (middle < high - apart_m)
            sharp = np.abs(np.diff(depth, axis=1)) > step_m
        # The sides of a mixed pixel are no steps of their own.
        sharp[:, :-1] &= ~between
        sharp[:, 1:] &= ~between
        mixed += int(between.sum())
        steps += int(sharp.sum()) + int(between.sum())
    return mixed, steps


def table_noise(depth_m: np.ndarray, block: int = 24) -> tuple[float, float]:
    """Noise of the table, free of its bow and of the device's distortion.

    Planes are fitted to blocks of `block` px that lie on the table as a whole.

    Returns:
        RMS distance to them in metres, and sub-pixel RMS with the infrared camera's f B.
    """
    height, width = depth_m.shape
    normal, distance = table_plane(depth_m)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    x, y = (u - (width - 1) / 2) / FOCAL_PX, (v - (height - 1) / 2) / FOCAL_PX
    off = depth_m * (normal[0] * x + normal[1] * y + normal[2]) - distance
    on_table = np.abs(off) < 0.015
    fits = []
    for top in range(0, height - block, block):
        for left in range(0, width - block, block):
            part = (slice(top, top + block), slice(left, left + block))
            if on_table[part].mean() > 0.98:
                good = on_table[part]
                fits.append(
                    metrics.fit_plane(
                        depth_m[part][good], x[part][good], y[part][good], FOCAL_BASELINE
                    )
                )
    rms_m = np.array([fit.rms_m for fit in fits])
    return metrics.rms(rms_m), metrics.rms(np.array([fit.subpixel_rms_px for fit in fits]))


def table_plane(depth_m: np.ndarray, seed: int = 0) -> tuple[np.ndarray, float]:
    """The plane that most points lie on (RANSAC, then least squares): unit normal, distance."""
    rows, cols = np.nonzero(np.isfinite(depth_m))
    height, width = depth_m.shape
    z = depth_m[rows, cols].astype(np.float64)
    x, y = (cols - (width - 1) / 2) / FOCAL_PX, (rows - (height - 1) / 2) / FOCAL_PX
    points = np.stack([x * z, y * z, z], axis=1)
    some = points[:: max(1, len(points) // 20_000)]
    rng = np.random.default_rng(seed)
    best, count = (np.array([0, 0, 1.0]), 0.0), -1
    for _ in range(200):
        a, b, c = some[rng.choice(len(some), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-9:
            continue
        normal /= length
        near = int((np.abs((some - a) @ normal) < 0.008).sum())
        if near > count:
            best, count = (normal, float(a @ normal)), near
    on = points[np.abs(points @ best[0] - best[1]) < 0.01]
    centre = on.mean(axis=0)
    normal = np.linalg.svd((on - centre)[:: max(1, len(on) // 20_000)], full_matrices=False)[2][2]
    return normal, float(centre @ normal)
