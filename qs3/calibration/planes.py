"""A sensor before planes of known depth and tilt: one row of numbers a condition.

What is measured is defined as in librealsense's depth-quality tool
(tools/depth-quality/rs-depth-quality.cpp): fill rate is the share of valid pixels in the region
looked at; the nearest and farthest 0.5 % of the points are dropped and a plane is fitted; sub-pixel
RMS is that of f B / Z - f B / Z_plane, and Z accuracy the median of the signed error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.calibration.subject import ALBEDO, POSE, Subject, TiltedPlane
from qs3.sensors.base import DepthFrame
from qs3.sensors.devices.fitted import FittedDepth
from qs3.sensors.renderers.base import Renderer

TRIM = 0.005
_GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class PlanarCondition:
    """Planes around one depth, at one tilt.

    Attributes:
        depth_m: in the middle of the depths of this condition.
        tilt_deg: angle of incidence, 0..85; both signs of it are pooled.
        along: the plane recedes along the baseline, else across it.
        phases: how many planes; their disparities are spread over one whole pixel, so that
            every sub-pixel place of a match counts alike.
        half_px: half the side of the region that is measured, in samples of the depth image.
    """

    depth_m: float
    tilt_deg: float = 0.0
    along: bool = True
    phases: int = 16
    half_px: int = 24

    def depths_m(self, focal_baseline: float | None) -> np.ndarray:
        """[phases] depths: whole disparity pixels for a sensor that triangulates.

        Evenly spread with a shift of the golden ratio within each slot, so that they fall on
        every place within the steps of a quantiser, too. Others get +-2 % of the depth.
        """
        k = np.arange(self.phases)
        place = (k + (k * _GOLDEN) % 1) / self.phases - 0.5  # -0.5 .. 0.5
        if focal_baseline is None:
            return self.depth_m * (1 + 0.04 * place)
        return focal_baseline / (focal_baseline / self.depth_m + place)


@dataclass(frozen=True)
class _Part:
    """One frame: [N] errors and disparities, the RMS beside its own plane, the stated noise.

    `residual` [h, w] is the disparity less that of the fitted plane, NaN where there is none.
    """

    error_m: np.ndarray
    error_px: np.ndarray
    disparity: np.ndarray
    plane_rms_m: float
    subpixel_rms_px: float
    residual: np.ndarray
    wanted: int
    law_m: float


def measure(
    subject: Subject, condition: PlanarCondition, renderer: Renderer, seed: int = 0
) -> dict[str, Any]:
    """Render and measure one condition; the same call gives the same numbers.

    Returns:
        sensor, depth_m, tilt_deg, recedes ("", "along" or "across" the baseline), and the numbers,
        NaN where there is no such thing:
        pixels: of the region, over all planes.
        fill: share of them that is valid.
        sigma_m, bias_m: standard deviation and median of depth minus true depth over all planes,
            the former without the outer 2 x 0.5 %.
        accuracy: bias over depth.
        plane_rms_m, subpixel_rms_px: about the plane fitted to each image.
        sigma_px, bias_px: as sigma_m and bias_m, of the disparity.
        outliers: share of disparities that are off by more than 1 px.
        correlation_px: over how many pixels noise is shared, see `correlation_px`.
        levels, levels_expected: distinct depths between the nearest and the farthest plane.
        law_m: noise that the sensor states itself.
    """
    parts, fb = [], subject.focal_baseline
    depths = condition.depths_m(fb)
    for k, depth in enumerate(depths):
        # Elsewhere in the image for each plane: other dots of the pattern.
        angle, away = 2 * np.pi * _GOLDEN * k, 12.0 + 24.0 * (k % 4) / 4
        centre = (away * np.cos(angle) * subject.step_px, away * np.sin(angle) * subject.step_px)
        sign = 1 if k % 2 else -1
        plane = TiltedPlane(float(depth), sign * condition.tilt_deg, condition.along, centre)
        rng = np.random.default_rng([seed, k])
        parts.append(_part(subject, plane, *take(subject, plane, condition.half_px, renderer, rng)))
    facing = condition.tilt_deg == 0
    error = np.concatenate([part.error_m for part in parts])
    wanted = sum(part.wanted for part in parts)
    out: dict[str, Any] = {
        "sensor": subject.name,
        "depth_m": condition.depth_m,
        "tilt_deg": float(condition.tilt_deg),
        "recedes": "" if facing else "along" if condition.along else "across",
        "pixels": wanted,
        "fill": len(error) / wanted,
        "sigma_m": _spread(error),
        "bias_m": _median(error),
        "accuracy": _median(error) / condition.depth_m,
        "plane_rms_m": _pooled([part.plane_rms_m for part in parts]),
        "law_m": _pooled([part.law_m for part in parts]) if facing else np.nan,
    }
    if fb is None:
        return out
    error_px = np.concatenate([part.error_px for part in parts])
    out |= {
        "subpixel_rms_px": _pooled([part.subpixel_rms_px for part in parts]),
        "sigma_px": _spread(error_px),
        "bias_px": _median(error_px),
        "outliers": float(np.mean(np.abs(error_px) > 1)) if error_px.size else np.nan,
    }
    if facing:
        residuals = [part.residual for part in parts]
        out["correlation_px"] = correlation_px(residuals) * subject.step_px
    if subject.steps_per_px:
        low, high = float((fb / depths).min()), float((fb / depths).max())
        found = np.concatenate([part.disparity for part in parts])
        found = found[(found >= low) & (found <= high)]
        out["levels"] = len(np.unique(np.rint(found * 1024)))
        out["levels_expected"] = expected_levels(
            low, high, subject.steps_per_px, subject.level_offset_px
        )
    return out


def take(
    subject: Subject,
    plane: TiltedPlane,
    half_px: int,
    renderer: Renderer,
    rng: np.random.Generator,
) -> tuple[DepthFrame, tuple[slice, slice]]:
    """A frame of a plane, and the samples of it (rows, columns) that lie in the region."""
    k, step = subject.sensor.intrinsics, subject.step_px
    region = plane.region(k, half_px * step, step)
    bodies, box = plane.scene(k, region, subject.margin_px)
    frame = subject.sensor.scan(bodies, box, POSE, renderer, rng)
    assert frame is not None, "the plane is outside the view"
    rows = _samples(region.top, region.height, frame.top, frame.step_px)
    cols = _samples(region.left, region.width, frame.left, frame.step_px)
    return frame, (rows, cols)


def _samples(start: int, length: int, first: int, step: int) -> slice:
    """Samples at first + i step that lie in [start, start + length)."""
    low = max(0, -(-(start - first) // step))
    return slice(low, (start + length - 1 - first) // step + 1)


def _part(
    subject: Subject, plane: TiltedPlane, frame: DepthFrame, part: tuple[slice, slice]
) -> _Part:
    depth, clean = (a[part].astype(np.float64) for a in (frame.depth_m, frame.clean_m))
    wanted = np.isfinite(clean)
    valid = wanted & np.isfinite(depth)
    rows, cols = np.nonzero(valid)
    k, fb = frame.camera.intrinsics, subject.focal_baseline
    x = (frame.left + (cols + part[1].start) * frame.step_px - k.cx_px) / k.focal_px
    y = (frame.top + (rows + part[0].start) * frame.step_px - k.cy_px) / k.focal_px
    z, truth = depth[valid], clean[valid]
    residual = np.full(depth.shape, np.nan)
    rms_m, inverse = fit_plane(z, x, y)
    if fb is not None:
        residual[valid] = fb / z - fb * (inverse @ np.stack([x, y, np.ones_like(x)]))
    order = np.argsort(z, kind="stable")
    cut = int(len(order) * TRIM)
    inner = residual[valid][order[cut : len(order) - cut]]
    nothing = np.zeros(0)
    return _Part(
        error_m=z - truth,
        error_px=nothing if fb is None else fb / z - fb / truth,
        disparity=nothing if fb is None else fb / z,
        plane_rms_m=rms_m,
        subpixel_rms_px=_rms(inner),
        residual=residual,
        wanted=int(wanted.sum()),
        law_m=stated_sigma_m(subject.sensor, plane.depth_m, frame),
    )


def fit_plane(depth_m: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Total least squares through [N] points, without the nearest and farthest 0.5 %.

    Args:
        depth_m: metres along the optical axis, finite.
        x, y: tangents of the rays, (u - cx) / f and (v - cy) / f.

    Returns:
        RMS of the distances to the plane, and [3] (a, b, c) of 1 / Z = a x + b y + c; NaN for
        fewer than 10 points.
    """
    if len(depth_m) < 10:
        return np.nan, np.full(3, np.nan)
    order = np.argsort(depth_m, kind="stable")
    cut = int(len(order) * TRIM)
    keep = order[cut : len(order) - cut]
    z, x, y = (np.asarray(a, dtype=np.float64)[keep] for a in (depth_m, x, y))
    points = np.stack([x * z, y * z, z], axis=1)
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    # n . (x, y, 1) Z = n . centre, so 1 / Z is linear in x and y.
    return _rms((points - centre) @ normal), normal / (normal @ centre)


def stated_sigma_m(sensor: Any, depth_m: float, frame: DepthFrame) -> float:
    """Standard deviation of the depth of a plane that faces the sensor, by the sensor's own law.

    Args:
        sensor: any; those that state no law give NaN.
        depth_m: of the plane, whose albedo is ALBEDO.
        frame: of that plane, for exposures that no one knows beforehand.
    """
    if isinstance(sensor, FittedDepth):  # its law is that before the quantiser
        steps = (sensor.inverse_step_per_m * depth_m**2, sensor.depth_step_m)
        rounding = np.hypot(*steps) / np.sqrt(12)
        return float(np.hypot(sensor.noise_law_m(depth_m), rounding))
    if hasattr(sensor, "distance_sigma_m"):  # time of flight: light falls with the square
        lamp = sensor.electrons_at_1m * ALBEDO / depth_m**2
        mean = lamp + sensor.electrons_at_1m * ALBEDO * sensor.ambient
        return float(sensor.distance_sigma_m(sensor.contrast * lamp, mean))
    if hasattr(sensor, "depth_sigma_m") and "modulation" in frame.images:  # fringes
        modulation = float(np.median(frame.images["modulation"]))
        per_grey = sensor.infrared.electrons_at_white / 255
        mean_e = float(frame.images["exposures"].mean()) * per_grey
        shot_and_read = np.sqrt(mean_e + sensor.infrared.read_noise_e**2) / per_grey
        noise = float(np.hypot(shot_and_read, np.sqrt(1 / 12)))  # and whole grey values
        return float(sensor.depth_sigma_m(depth_m, noise, modulation))
    return float(getattr(sensor, "noise_sigma_m", np.nan))


def _rms(values: np.ndarray) -> float:
    """Root of the mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else np.nan


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if values.size else np.nan


def _spread(values: np.ndarray) -> float:
    """Standard deviation without the lowest and the highest 0.5 %; NaN of nothing."""
    values = np.sort(values[np.isfinite(values)], axis=None)
    cut = int(len(values) * TRIM)
    kept = values[cut : len(values) - cut]
    return float(np.std(kept)) if kept.size else np.nan


def _pooled(values: Sequence[float]) -> float:
    """Root of the mean of the squares of each frame's."""
    found = np.array(values)
    return _rms(found[np.isfinite(found)])


def expected_levels(low_px: float, high_px: float, steps_per_px: int, offset_px: float) -> int:
    """How many steps k / steps_per_px + offset_px lie in [low_px, high_px]."""
    first = np.ceil((low_px - offset_px) * steps_per_px - 1e-6)
    last = np.floor((high_px - offset_px) * steps_per_px + 1e-6)
    return int(max(0, last - first + 1))


def correlation_px(residuals: Sequence[np.ndarray]) -> float:
    """Over how many pixels noise is shared: where its correlation has fallen to one half.

    `residuals` are [h, w] with NaN and mean 0; rows and columns of all are pooled, and the
    correlation is interpolated between whole pixels. NaN if it does not fall so far.
    """
    before = 1.0
    power = np.concatenate([image.ravel() ** 2 for image in residuals])
    if not np.isfinite(power).any():
        return np.nan
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
    return np.nan
