"""The planar-target bench: one sensor before planes of known depth and tilt."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from qs3.calibration.bench import metrics
from qs3.calibration.bench.cached_renderer import StillRenderer
from qs3.calibration.bench.subject import Subject
from qs3.calibration.bench.targets import ALBEDO, POSE, TiltedPlane
from qs3.errors import ConfigError
from qs3.sensors.base import DepthFrame
from qs3.sensors.devices.fitted import FittedDepth
from qs3.sensors.renderers.base import Renderer

_GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class PlanarCondition:
    """Planes around one depth, at one tilt.

    Attributes:
        depth_m: in the middle of the depths of this condition.
        tilt_deg: angle of incidence, 0..85; both signs of it are pooled.
        across: the plane recedes along the baseline, else across it.
        phases: how many planes; their disparities are spread over one whole pixel, so that
            every sub-pixel place of a match counts alike.
        half_px: half the side of the region that is measured, in samples of the depth image.
        repeats: frames of the same scene for the noise over time; 0 leaves it out.
    """

    depth_m: float
    tilt_deg: float = 0.0
    across: bool = True
    phases: int = 16
    half_px: int = 24
    repeats: int = 0

    @property
    def name(self) -> str:
        """For file names and messages."""
        axis = "" if self.tilt_deg == 0 else ("-across" if self.across else "-along")
        return f"plane-{self.depth_m:g}m-{self.tilt_deg:g}deg{axis}"

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
    """What one frame says: [N] errors, disparities, the fitted plane, the noise that is stated.

    `residual` [h, w] is the disparity less that of the fitted plane, NaN where there is none.
    """

    error_m: np.ndarray
    error_px: np.ndarray
    disparity: np.ndarray
    plane: metrics.PlaneFit
    residual: np.ndarray
    wanted: int
    reasons: np.ndarray
    law_m: float | None


def measure(
    subject: Subject, condition: PlanarCondition, renderer: Renderer, seed: int = 0
) -> dict[str, Any]:
    """Render and measure one condition.

    Args:
        subject: the sensor and what is known about it.
        condition: which planes.
        renderer: makes the images.
        seed: of all noise; the same call gives the same numbers.

    Returns:
        The metrics by name, plain numbers and lists (None where there is no such thing).
    """
    parts, stills = [], []
    depths = condition.depths_m(subject.focal_baseline)
    for k, depth in enumerate(depths):
        # Elsewhere in the image for each plane: other dots of the pattern.
        angle, away = 2 * np.pi * _GOLDEN * k, 12.0 + 24.0 * (k % 4) / 4
        centre = (away * np.cos(angle) * subject.step_px, away * np.sin(angle) * subject.step_px)
        sign = 1 if k % 2 else -1
        plane = TiltedPlane(float(depth), sign * condition.tilt_deg, condition.across, centre)
        if k < 3 and condition.repeats:
            still = StillRenderer(renderer, seed=k)
            noise = [np.random.default_rng([seed, k, i]) for i in range(condition.repeats)]
            frames = [take(subject, plane, condition.half_px, still, rng) for rng in noise]
            stills.append(np.stack([frame.depth_m[part] for frame, part in frames]))
        rng = np.random.default_rng([seed, k])
        seen = take(subject, plane, condition.half_px, renderer, rng)
        parts.append(_part(*seen, subject, plane))
    return _summary(subject, condition, parts, depths, stills)


def take(
    subject: Subject,
    plane: TiltedPlane,
    half_px: int,
    renderer: Renderer,
    rng: np.random.Generator,
) -> tuple[DepthFrame, tuple[slice, slice]]:
    """A frame of a plane, and the samples of it (rows, columns) that lie in the region."""
    k, step = subject.intrinsics, subject.step_px
    region = plane.region(k, half_px * step, step)
    bodies, box = plane.scene(k, region, subject.margin_px)
    if isinstance(renderer, StillRenderer):
        renderer.rewind()
    frame = subject.sensor.scan(bodies, box, POSE, renderer, rng)
    if frame is None:
        where = f"a plane at {plane.depth_m:g} m, {plane.tilt_deg:g} degrees"
        raise ConfigError(f"{where}, is outside the view of sensor={subject.name}")
    rows = _samples(region.top, region.height, frame.top, frame.step_px)
    cols = _samples(region.left, region.width, frame.left, frame.step_px)
    return frame, (rows, cols)


def _samples(start: int, length: int, first: int, step: int) -> slice:
    """Samples at first + i step that lie in [start, start + length)."""
    low = max(0, -(-(start - first) // step))
    return slice(low, (start + length - 1 - first) // step + 1)


def _part(
    frame: DepthFrame, part: tuple[slice, slice], subject: Subject, plane: TiltedPlane
) -> _Part:
    depth, clean = (a[part].astype(np.float64) for a in (frame.depth_m, frame.clean_m))
    wanted = np.isfinite(clean)
    valid = wanted & np.isfinite(depth)
    rows, cols = np.nonzero(valid)
    k, fb = frame.camera.intrinsics, subject.focal_baseline
    x = (frame.left + (cols + part[1].start) * frame.step_px - k.cx_px) / k.focal_px
    y = (frame.top + (rows + part[0].start) * frame.step_px - k.cy_px) / k.focal_px
    z, truth = depth[valid], clean[valid]
    facing = plane.tilt_deg == 0
    fitted = metrics.fit_plane(z, x, y, fb)
    residual = np.full(depth.shape, np.nan)
    if fb is not None:
        residual[valid] = fb / z - fb * (fitted.inverse @ np.stack([x, y, np.ones_like(x)]))
    return _Part(
        error_m=z - truth,
        error_px=np.zeros(0) if fb is None else fb / z - fb / truth,
        disparity=np.zeros(0) if fb is None else fb / z,
        plane=fitted,
        residual=residual,
        wanted=int(wanted.sum()),
        reasons=np.bincount(frame.reason[part][wanted], minlength=32),
        law_m=stated_sigma_m(subject.sensor, plane.depth_m, frame) if facing else None,
    )


def stated_sigma_m(sensor: Any, depth_m: float, frame: DepthFrame) -> float | None:
    """Standard deviation of the depth of a plane that faces the sensor, by the sensor's own law.

    Args:
        sensor: any; those that state no law give None.
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
    if hasattr(sensor, "noise_sigma_m"):
        return float(sensor.noise_sigma_m)
    return None


def _summary(
    subject: Subject,
    condition: PlanarCondition,
    parts: list[_Part],
    depths: np.ndarray,
    stills: list[np.ndarray],
) -> dict[str, Any]:
    fb = subject.focal_baseline
    error = np.concatenate([part.error_m for part in parts])
    kept, wanted = metrics.trimmed(error), sum(part.wanted for part in parts)
    reasons = np.sum([part.reasons for part in parts], axis=0)
    out: dict[str, Any] = {
        "condition": asdict(condition),
        "frames": len(depths),
        "pixels": wanted,
        "fill": len(error) / wanted if wanted else 0.0,
        "sigma_m": float(np.std(kept)) if kept.size else None,
        "bias_m": metrics.median(error),
        "accuracy": metrics.median(error) / condition.depth_m,
        "plane_rms_m": _pooled([part.plane.rms_m for part in parts]),
        "reasons": {str(i): int(n) for i, n in enumerate(reasons) if n},
        "law_m": _pooled([part.law_m for part in parts if part.law_m is not None]),
    }
    if stills:
        spread = [_temporal(stack) for stack in stills]
        out["temporal"] = metrics.median(np.concatenate(spread))
        out["temporal_std_m"] = [float(np.nanmean(_over_time(stack))) for stack in stills]
    if fb is not None:
        errors = [part.error_px for part in parts]
        error_px = np.concatenate(errors)
        disparity = np.concatenate([part.disparity for part in parts])
        phase = (fb / depths - subject.whole_px) % 1
        mean = np.array([float(np.mean(e)) if e.size else np.nan for e in errors])
        out |= {
            "subpixel_rms_px": _pooled([part.plane.subpixel_rms_px for part in parts]),
            "sigma_px": float(np.std(metrics.trimmed(error_px))),
            "bias_px": metrics.median(error_px),
            "outliers": float(np.mean(np.abs(error_px) > 1)) if error_px.size else None,
            "phase": phase.tolist(),
            "phase_bias_px": [metrics.median(e) for e in errors],
            "locking_px": metrics.locking_px(phase, mean) if condition.tilt_deg == 0 else None,
            "phase_histogram": _histogram(disparity - subject.whole_px),
        }
        if condition.tilt_deg == 0:
            maps = [part.residual for part in parts]
            out["correlation_px"] = metrics.correlation_px(maps) * subject.step_px
        out |= _levels(subject, disparity, fb / depths)
    return without_nan(out)


def _levels(subject: Subject, disparity: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Distinct depths between the nearest and the farthest plane, and how many there should be."""
    if not subject.steps_per_px:
        return {}
    low, high = float(truth.min()), float(truth.max())
    found = metrics.levels(disparity[(disparity >= low) & (disparity <= high)])
    offset = subject.level_offset_px
    return {
        "levels": len(found),
        "levels_expected": metrics.expected_levels(low, high, subject.steps_per_px, offset),
    }


def _pooled(values: list[float]) -> float | None:
    """Root of the mean of the squares of each frame's."""
    finite = np.array([v for v in values if np.isfinite(v)])
    return metrics.rms(finite) if finite.size else None


def _temporal(stack: np.ndarray) -> np.ndarray:
    """[frames, h, w] -> std / median of every pixel that is always valid."""
    good = np.isfinite(stack).all(axis=0)
    return _over_time(stack) / np.median(stack[:, good].astype(np.float64), axis=0)


def _over_time(stack: np.ndarray) -> np.ndarray:
    """[frames, h, w] -> std of every pixel that is always valid, in metres."""
    good = np.isfinite(stack).all(axis=0)
    return stack[:, good].astype(np.float64).std(axis=0, ddof=1)


def _histogram(disparity: np.ndarray, bins: int = 32) -> list[float]:
    """Shares of measured disparities by their fraction of a pixel, in bins around i / bins."""
    counts, _ = np.histogram((disparity + 0.5 / bins) % 1, bins=bins, range=(0, 1))
    return (counts / max(counts.sum(), 1)).tolist()


def without_nan(value: Any) -> Any:
    """NaN becomes None, so that JSON can hold it."""
    if isinstance(value, dict):
        return {key: without_nan(v) for key, v in value.items()}
    if isinstance(value, list):
        return [without_nan(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
