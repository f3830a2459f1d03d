"""What must hold of each sensor, and whether it does.

The limits come from devices or from geometry, never from what a sensor of ours happened to give.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from qs3.calibration.subject import Subject
from qs3.calibration.walls import TRIMMED_NORMAL
from qs3.sensors.devices.fitted import FittedDepth

D400_RMS_PX = (0.03, 0.10)
"""Sub-pixel RMS that a D400 preset may have. Of a real one on a well-textured wall 0.032 is
possible and 0.08 to count on (Grunnet-Jepsen, librealsense #3904); simulators of it assume 0.10."""

D400_ACCURACY = (0.02, 2.0)
"""Z accuracy of the D400 data sheet: within 2 % up to 2 m."""

D435_M = (0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
"""Where Kotsonis' noise of a real D435 (0.2 to 3.25 m) is asked of a D435 preset. Below 0.5 m it is
that of the whole steps of his depth images, not of the disparity; beyond, on a plain wall in a lit
room, its dots are too dim for the texture that Intel's sub-pixel RMS asks for."""

FILL_TILTED = {80.0: (0.3, 1.0), 85.0: (0.0, 0.7)}
"""Fill of planes that are nearly edge-on (in degrees), where D400s lose pixels. By geometry: at 80
degrees and 2 m the disparity changes by 2 px and more across a D415's window, at 85 degrees by 5,
where one or two are the most that a single shift fits; at the same time a dot's light falls with
the cosine. No published count of their pixels was found, so the ranges are wide."""

REAL_D415 = {"subpixel_rms_px": (0.09, 0.16), "correlation_px": (5.6, 9.4), "fill": (0.97, 1.0)}
"""A real D415's own depth at 1 m: sub-pixel RMS of a plane 0.125 px, correlation length of its
noise 7.5 px, both with 25 to 30 % either way, as they are of one plane; fill 98 %, and a percent
less."""

NGUYEN_M = (1.0, 1.5, 2.0, 3.0, 4.0)


def nguyen_axial_m(depth_m: np.ndarray | float) -> np.ndarray:
    """Axial noise of Kinect v1 up to 60 degrees (Nguyen, Izadi and Lovell, 3DIMPVT 2012)."""
    return 0.0012 + 0.0019 * (np.asarray(depth_m, dtype=np.float64) - 0.4) ** 2


def kotsonis_d435_m(depth_m: np.ndarray | float) -> np.ndarray:
    """Axial noise of a D435 as measured by L. Kotsonis (elevation_mapping, 0.2 to 3.25 m)."""
    return 0.000611 + 0.003587 * (np.asarray(depth_m, dtype=np.float64) - 0.3515) ** 2


@dataclass(frozen=True)
class Band:
    """What is asked of one sensor: `value` within `low` and `high`, both included.

    A value that could not be measured is NaN, and does not hold.
    """

    sensor: str
    band: str
    value: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """Whether the value lies within the limits."""
        return self.low <= self.value <= self.high


def judge(subject: Subject, planes: pd.DataFrame, edge: dict[str, Any]) -> list[Band]:
    """All bands that apply to a sensor.

    Args:
        subject: the sensor. A preset by `qs3 fit` is held against what it states itself, which its
            camera's frames show; the others are judged by their names.
        planes: rows of `planes.measure`.
        edge: a row of `edges.measure`, or nothing.
    """
    name, sensor = subject.name, subject.sensor
    fitted = isinstance(sensor, FittedDepth)
    facing = planes[planes.tilt_deg == 0]
    gentle = planes[planes.tilt_deg <= 45]
    found: list[tuple[str, float, float, float]] = []
    if subject.focal_baseline is not None:
        if not fitted:
            near = facing[facing.depth_m <= (max(D435_M) if "d435" in name else np.inf)]
            found.append(("sigma_Z grows as Z^p: p", exponent(near), 1.8, 2.2))
        found += _bias(subject, facing) + _levels(subject, facing)
    if not fitted:
        found += _device(name, planes, facing)
    law = facing.sigma_m / (facing.law_m * TRIMMED_NORMAL)
    if law.notna().any():
        found.append(("sigma_Z over the sensor's own law", _farthest(law, 1.0), 0.9, 1.1))
    if isinstance(sensor, FittedDepth):
        stated = np.interp(gentle.tilt_deg, sensor.tilts_deg, sensor.fill_rates)
        off = _farthest(1 + gentle.fill - stated, 1.0) - 1
        found.append(("fill beside the preset's own up to 45 degrees", off, -0.05, 0.05))
    else:
        found.append(("fill up to 45 degrees", float(gentle.fill.min()), 0.95, 1.0))
    return [Band(name, *each) for each in found + _edge(edge)]


def exponent(facing: pd.DataFrame) -> float:
    """Exponent p of sigma = a Z^p, by least squares on the logarithms."""
    good = facing[facing.sigma_m > 0]
    if len(good) < 2:
        return np.nan
    return float(np.polyfit(np.log(good.depth_m), np.log(good.sigma_m), 1)[0])


def _farthest(values: pd.Series | np.ndarray, middle: float) -> float:
    """The value that is the farthest from the middle of its band."""
    values = np.asarray(values, dtype=float)
    if np.isnan(values).all():
        return np.nan
    return float(values[np.nanargmax(np.abs(values - middle))])


def _bias(subject: Subject, facing: pd.DataFrame) -> list[tuple[str, float, float, float]]:
    """Pooled over phases: 0.02 px for a D400, else a quarter of a step of the disparity.

    What a device's calibration leaves is a bias too: of such a sensor the data sheet's is asked.
    Of a fitted preset the bias that it states is taken off, and its own steps count.
    """
    sensor, fb = subject.sensor, subject.focal_baseline or 0.0
    if _is_misaligned(sensor):
        most, reach = D400_ACCURACY
        value = _farthest(facing[facing.depth_m <= reach].accuracy, 0.0)
        return [(f"Z accuracy up to {reach:g} m", value, -most, most)]
    off, z = facing.bias_px.to_numpy(), facing.depth_m.to_numpy()
    limit = 0.02 if "d4" in subject.name else 0.25 / (subject.steps_per_px or 16)
    shares = off / limit
    if isinstance(sensor, FittedDepth):
        stated = z + np.polynomial.polynomial.polyval(z, sensor.bias_m)
        own = np.maximum(sensor.inverse_step_per_m, sensor.depth_step_m / z**2)
        shares = (off - (fb / stated - fb / z)) / (0.25 * np.maximum(abs(fb) * own, 1 / 16))
        return [("median bias over a quarter of a step", _farthest(shares, 0.0), -1.0, 1.0)]
    return [("median bias of the disparity, px", limit * _farthest(shares, 0.0), -limit, limit)]


def _levels(subject: Subject, facing: pd.DataFrame) -> list[tuple[str, float, float, float]]:
    """As many distinct depths as the quantiser has steps.

    What a calibration leaves moves the first and the last plane: up to a level a distance may
    be missing then.
    """
    if not subject.steps_per_px:
        return []
    wanted = float(facing.levels_expected.sum())
    least = wanted - len(facing) * _is_misaligned(subject.sensor)
    band = f"distinct levels of depth, by steps of 1/{subject.steps_per_px} px"
    return [(band, float(facing.levels.sum()), least, wanted)]


def _is_misaligned(sensor: Any) -> bool:
    return bool(getattr(getattr(sensor, "misalignment", None), "columns_px", 0))


def _device(
    name: str, planes: pd.DataFrame, facing: pd.DataFrame
) -> Iterable[tuple[str, float, float, float]]:
    """The published noise and fill of the device that a preset is named for."""
    by_depth = facing.set_index("depth_m")
    if name.startswith("kinect_v1"):
        for z in NGUYEN_M:
            ratio = by_depth.sigma_m.get(z, np.nan) / float(nguyen_axial_m(z))
            yield f"sigma_Z at {z:g} m over Nguyen's", float(ratio), 0.7, 1.3
    if "d415" in name:
        for key, (low, high) in REAL_D415.items():
            yield f"{key} at 1 m, a real D415's", float(by_depth[key].get(1.0, np.nan)), low, high
    elif "d4" in name:
        low, high = D400_RMS_PX
        near = facing[facing.depth_m <= max(D435_M)]
        yield "sub-pixel RMS, px", _farthest(near.subpixel_rms_px, (low + high) / 2), low, high
    if "d435" in name:
        asked = facing[facing.depth_m.isin(D435_M)]
        ratio = np.log(asked.sigma_m / kotsonis_d435_m(asked.depth_m))
        yield "sigma_Z over a real D435's (Kotsonis)", float(np.exp(_farthest(ratio, 0))), 0.7, 1.3
    for tilt, (low, high) in FILL_TILTED.items():
        if "d4" in name and (planes.tilt_deg == tilt).any():  # a quick bench leaves them out
            value = float(planes.fill[planes.tilt_deg == tilt].mean())
            yield f"fill at {tilt:g} degrees", value, low, high


def _edge(edge: dict[str, Any]) -> list[tuple[str, float, float, float]]:
    """Shadows on the side that geometry says, and no more blur than half a window."""
    out = []
    for who in ("camera", "projector"):
        expected = edge.get(f"{who}_expected_px", np.nan)
        left, right = (edge.get(f"{who}_{side}_px", np.nan) for side in ("left", "right"))
        if np.isfinite([expected, left, right]).all():
            # What the other camera or the projector at +x does not reach is left of the square.
            wide, none = (left, right) if expected >= 0 else (right, left)
            worst = max(abs(wide - abs(expected)), none)
            out.append((f"{who} shadow beside geometry's, px", worst, 0.0, 2.0))
    half = edge.get("half_window_px", np.nan)
    if np.isfinite([half, edge.get("reaches_px", np.nan)]).all():
        worst = max(abs(edge["reaches_px"]), abs(np.nan_to_num(edge["wall_px"], nan=np.inf)))
        out.append(("open edge blurred, px", float(worst), 0.0, half + 1))
    return out
