"""A sensor in front of planes of known depth and tilt: one row of numbers a condition.

What is measured is defined as in librealsense's depth-quality tool
(tools/depth-quality/rs-depth-quality.cpp): fill rate is the share of valid pixels in the region
looked at; the nearest and farthest 0.5 % of the points are dropped and a plane is fitted; sub-pixel
RMS is that of f B / Z - f B / Z_plane, and Z accuracy the median of the signed error.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import trimboth

from qs3.calibration.subject import POSE, Subject, box_of, quad
from qs3.geometry.cameras import Intrinsics, Window
from qs3.sensors.base import DepthFrame
from qs3.sensors.renderers.base import Renderer

_TRIM = 0.005
_GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class TiltedPlane:
    """A plane through a point of a pixel's ray, turned away from that ray.

    Attributes:
        depth_m, tilt_deg: at the centre of the region, along the optical axis and from the ray;
            the sign of the tilt is the side to which the plane recedes.
        along: it recedes along the rows of the image (along the baseline), else along columns.
        centre_px: (u, v) of the region's centre, relative to the principal point.
    """

    depth_m: float
    tilt_deg: float = 0.0
    along: bool = True
    centre_px: tuple[float, float] = (0.0, 0.0)

    def inverse(self, focal_px: float) -> np.ndarray:
        """[3] (a, b, c) of 1 / Z = a x + b y + c, with x, y the tangents of a ray."""
        ray = np.array([self.centre_px[0] / focal_px, self.centre_px[1] / focal_px, 1.0])
        unit = ray / np.linalg.norm(ray)
        slope = np.array([1.0, 0, 0]) if self.along else np.array([0, 1.0, 0])
        slope -= (slope @ unit) * unit
        slope /= np.linalg.norm(slope)
        angle = np.deg2rad(self.tilt_deg)
        normal = np.cos(angle) * unit - np.sin(angle) * slope
        return normal / (normal @ ray * self.depth_m)

    def depth_at(self, u: np.ndarray, v: np.ndarray, focal_px: float) -> np.ndarray:
        """Depth at pixels relative to the principal point; not positive beyond the horizon."""
        a, b, c = self.inverse(focal_px)
        return 1 / (a * u / focal_px + b * v / focal_px + c)

    def region(self, k: Intrinsics, half_px: int, step_px: int = 1) -> Window:
        """The pixels to measure on: fewer where the depth would change much across them."""
        steep = abs(np.tan(np.deg2rad(self.tilt_deg)))
        flat = half_px if steep == 0 else min(half_px, int(0.12 * k.focal_px / steep))
        flat = max(flat, 2 * step_px + 1)
        wide, high = (flat, half_px) if self.along else (half_px, flat)
        u = round(k.cx_px + self.centre_px[0])
        v = round(k.cy_px + self.centre_px[1])
        return Window(u - wide, v - high, 2 * wide + 1, 2 * high + 1)

    def corners(self, k: Intrinsics, region: Window, margin_px: int) -> np.ndarray:
        """[4, 3] where the rays through the corners of a grown region meet the plane."""
        low_u, low_v = region.left - margin_px - k.cx_px, region.top - margin_px - k.cy_px
        high_u = low_u + region.width - 1 + 2 * margin_px
        high_v = low_v + region.height - 1 + 2 * margin_px
        # Not so far out that the plane comes near its horizon or the camera.
        a, b, _ = self.inverse(k.focal_px) * self.depth_m
        slope, centre = (a, self.centre_px[0]) if self.along else (b, self.centre_px[1])
        if slope:
            reach = 0.7 * k.focal_px / abs(slope)
            if self.along:
                low_u, high_u = max(low_u, centre - reach), min(high_u, centre + reach)
            else:
                low_v, high_v = max(low_v, centre - reach), min(high_v, centre + reach)
        u = np.array([low_u, high_u, high_u, low_u])
        v = np.array([low_v, low_v, high_v, high_v])
        z = self.depth_at(u, v, k.focal_px)
        return np.stack([u / k.focal_px * z, v / k.focal_px * z, z], axis=1)


def phases_m(depth_m: float, count: int, focal_baseline: float | None) -> np.ndarray:
    """[count] depths around one, over a whole pixel of disparity; else over +-2 % of the depth.

    Evenly spread with a shift of the golden ratio within each slot, so that they fall on every
    place within the steps of a quantiser, too.
    """
    k = np.arange(count)
    place = (k + (k * _GOLDEN) % 1) / count - 0.5  # -0.5 .. 0.5
    if focal_baseline is None:
        return depth_m * (1 + 0.04 * place)
    return focal_baseline / (focal_baseline / depth_m + place)


def measure(
    subject: Subject,
    renderer: Renderer,
    depth_m: float,
    tilt_deg: float = 0.0,
    along: bool = True,
    phases: int = 16,
    half_px: int = 24,
) -> dict[str, Any]:
    """Render and measure planes around one depth, at one tilt.

    Args:
        depth_m: in the middle of the depths of the planes.
        tilt_deg: angle of incidence, 0..85; both signs of it are pooled.
        along: the planes recede along the baseline, else across it.
        phases: how many planes; see `phases_m`.
        half_px: half the side of the region that is measured, in samples of the depth image.

    Returns:
        sensor, depth_m, tilt_deg, recedes ("", "along" or "across" the baseline), and the numbers:
        pixels: of the region, over all planes.
        fill: share of them that is valid.
        sigma_m, bias_m: standard deviation and median of depth minus true depth over all planes,
            the former without the outer 2 x 0.5 %.
        accuracy: bias over depth.
        subpixel_rms_px: of the disparity about the plane fitted to each image.
        bias_px: as bias_m, of the disparity.
        correlation_px: see `correlation_px`.
    """
    found: dict[str, list[Any]] = defaultdict(list)
    fb, facing = subject.focal_baseline, tilt_deg == 0
    for k, depth in enumerate(phases_m(depth_m, phases, fb)):
        # Elsewhere in the image for each plane: other dots of the pattern.
        angle, away = 2 * np.pi * _GOLDEN * k, 12.0 + 24.0 * (k % 4) / 4
        centre = (away * np.cos(angle) * subject.step_px, away * np.sin(angle) * subject.step_px)
        plane = TiltedPlane(float(depth), tilt_deg if k % 2 else -tilt_deg, along, centre)
        frame, part = take(subject, plane, half_px, renderer, np.random.default_rng([0, k]))
        for key, value in _measured(frame, part, fb).items():
            found[key].append(value)
    error, wanted = np.concatenate(found["error_m"]), sum(found["pixels"])
    out: dict[str, Any] = {
        "sensor": subject.name,
        "depth_m": depth_m,
        "tilt_deg": float(tilt_deg),
        "recedes": "" if facing else "along" if along else "across",
        "pixels": wanted,
        "fill": len(error) / wanted,
        "sigma_m": _spread(error),
        "bias_m": median(error),
        "accuracy": median(error) / depth_m,
    }
    if fb is None:
        return out
    out["subpixel_rms_px"] = _rms(np.array(found["rms_px"]))
    out["bias_px"] = median(np.concatenate(found["error_px"]))
    if facing:
        out["correlation_px"] = correlation_px(found["residual"]) * subject.step_px
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
    body = quad(plane.corners(k, region, 3 * subject.margin_px))
    box = box_of(plane.corners(k, region, subject.margin_px))
    frame = subject.sensor.scan((body,), box, POSE, renderer, rng)
    assert frame is not None, "the plane is outside the view"
    rows = _samples(region.top, region.height, frame.top, frame.step_px)
    cols = _samples(region.left, region.width, frame.left, frame.step_px)
    return frame, (rows, cols)


def _samples(start: int, length: int, first: int, step: int) -> slice:
    """Samples at first + i step that lie in [start, start + length)."""
    low = max(0, -(-(start - first) // step))
    return slice(low, (start + length - 1 - first) // step + 1)


def _measured(frame: DepthFrame, part: tuple[slice, slice], fb: float | None) -> dict[str, Any]:
    """Errors of one frame: [N] errors; [h, w] residuals from the fitted plane with NaN."""
    depth, clean = (a[part].astype(np.float64) for a in (frame.depth_m, frame.clean_m))
    wanted = np.isfinite(clean)
    valid = wanted & np.isfinite(depth)
    z, truth = depth[valid], clean[valid]
    out = {"error_m": z - truth, "pixels": int(wanted.sum())}
    if fb is None:
        return out
    rows, cols = np.nonzero(valid)
    k = frame.camera.intrinsics
    x = (frame.left + (cols + part[1].start) * frame.step_px - k.cx_px) / k.focal_px
    y = (frame.top + (rows + part[0].start) * frame.step_px - k.cy_px) / k.focal_px
    residual = np.full(depth.shape, np.nan)
    residual[valid] = fb / z - fb * (fit_plane(z, x, y) @ np.stack([x, y, np.ones_like(x)]))
    return out | {
        "error_px": fb / z - fb / truth,
        "rms_px": _rms(residual[valid][_inner(z)]),
        "residual": residual,
    }


def _inner(depth_m: np.ndarray) -> np.ndarray:
    """Indices of [N] depths without the nearest and farthest 0.5 %."""
    order = np.argsort(depth_m, kind="stable")
    cut = int(len(order) * _TRIM)
    return order[cut : len(order) - cut]


def fit_plane(depth_m: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[3] (a, b, c) of 1 / Z = a x + b y + c by total least squares; NaN for fewer than 10 points.

    Without the nearest and farthest 0.5 %. `depth_m` [N] is along the optical axis, and `x`, `y`
    are the tangents of the rays, (u - cx) / f and (v - cy) / f.
    """
    if len(depth_m) < 10:
        return np.full(3, np.nan)
    keep = _inner(depth_m)
    z, x, y = (np.asarray(a, dtype=np.float64)[keep] for a in (depth_m, x, y))
    points = np.stack([x * z, y * z, z], axis=1)
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    # n . (x, y, 1) Z = n . centre, so 1 / Z is linear in x and y.
    return normal / (normal @ centre)


def _rms(values: np.ndarray) -> float:
    """Root of the mean square of what is finite; NaN of nothing."""
    good = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(good)))) if good.size else np.nan


def median(values: np.ndarray) -> float:
    """Median of what is finite; NaN without any."""
    good = values[np.isfinite(values)]
    return float(np.median(good)) if good.size else np.nan


def _spread(values: np.ndarray) -> float:
    """Standard deviation without the lowest and the highest 0.5 %; NaN of nothing."""
    kept = trimboth(values[np.isfinite(values)], _TRIM)
    return float(np.std(kept)) if kept.size else np.nan


def correlation_px(residuals: Sequence[np.ndarray]) -> float:
    """Over how many pixels noise is shared: where its correlation has fallen to one half.

    `residuals` are [h, w] with NaN and mean 0; rows and columns of all are pooled, and the
    correlation is interpolated between whole pixels. NaN if it does not fall so far.
    """
    before, variance = 1.0, 0.0
    for lag in range(min(min(image.shape) for image in residuals)):
        pairs = []
        for image in residuals:
            high, wide = image.shape
            pairs += [image[:, lag:] * image[:, : wide - lag], image[lag:] * image[: high - lag]]
        products = np.concatenate([pair.ravel() for pair in pairs])
        if not np.isfinite(products).any():
            break
        here = float(np.nanmean(products))
        variance = variance or max(here, 1e-30)
        if lag and here <= 0.5 * variance:
            return lag - 1 + (before - 0.5) / (before - here / variance)
        before = here / variance
    return np.nan
