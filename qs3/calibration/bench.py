"""Known targets in front of a depth sensor: are its errors those of the device it stands for?

    qs3 bench sensor=kinect_v1,realsense_d435

renders planes and a square in front of a wall with the sensor's own settings, and measures what
comes back: planes.csv, edges.csv, bands.csv (what must hold, and whether it does), and a page of
them, sensors.md. The limits of bands come from devices or from geometry, never from what a sensor
of ours happened to give.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd

from qs3.calibration import edges, planes
from qs3.calibration.subject import Subject, load
from qs3.sensors.devices.fitted import FittedDepth
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from qs3.utils.files import make_folder, write_text
from qs3.utils.progress import shown

DEFAULT_SENSORS = (
    "kinect_v1", "structure_sensor", "realsense_d415", "realsense_d435", "speckle_stereo",
    "time_of_flight", "fringe", "kinect_like", "blensor_kinect", "blensor_tof",
)  # fmt: skip
"""On the page. Not on it: copies of others, and those that repeat a defect on purpose."""

_TILTS_DEG = (15, 30, 45, 60, 65, 70, 75, 80, 85)
_SHOWN_M = (0.5, 1.0, 2.0, 3.0, 4.0)
_SHOWN_DEG = (60.0, 75.0, 80.0, 85.0)

_D400_RMS_PX = (0.03, 0.10)
"""Sub-pixel RMS that a D400 preset may have. Of a real one on a well-textured wall 0.032 is
possible and 0.08 to count on (Grunnet-Jepsen, librealsense #3904); simulators of it assume 0.10."""

_D400_ACCURACY = (0.02, 2.0)
"""Z accuracy of the D400 data sheet: within 2 % up to 2 m."""

_D435_M = (0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
"""Where Kotsonis' noise of a real D435 (0.2 to 3.25 m) is asked of a D435 preset. Below 0.5 m it is
that of the whole steps of his depth images; beyond, on a plain wall in a lit room, its dots are too
dim for the texture that Intel's sub-pixel RMS asks for."""

_FILL_TILTED = {80.0: (0.3, 1.0), 85.0: (0.0, 0.7)}
"""Fill of planes that are nearly edge-on (in degrees), where D400s lose pixels. By geometry: at 80
degrees and 2 m the disparity changes by 2 px and more across a D415's window, at 85 degrees by 5,
where one or two are the most that a single shift fits. No published count was found, so the ranges
are wide."""

_REAL_D415 = {"subpixel_rms_px": (0.09, 0.16), "correlation_px": (5.6, 9.4), "fill": (0.97, 1.0)}
"""A real D415's own depth at 1 m: sub-pixel RMS of a plane 0.125 px, correlation length of its
noise 7.5 px, both with 25 to 30 % either way, as they are of one plane; fill 98 %."""

_NGUYEN_M = (1.0, 1.5, 2.0, 3.0, 4.0)

_Row = tuple[str, float, float, float]  # of a band: what, value, low, high


def conditions(subject: Subject, quick: bool = False) -> list[tuple[float, float, bool, int, int]]:
    """For `planes.measure`: all distances, and tilted both ways at the one nearest to 2 m."""
    fineness = (8, 16) if quick else (16, 24)
    depths = subject.depths_m()
    tilted = min(depths, key=lambda z: abs(z - 2.0))
    tilts = (45, 75) if quick else _TILTS_DEG
    facing = [(z, 0.0, True, *fineness) for z in depths]
    return facing + [(tilted, float(t), along, *fineness) for along in (True, False) for t in tilts]


def run(
    names: Sequence[str], overrides: Sequence[str], quick: bool, samples: int, out: Path
) -> list[Band]:
    """Measure sensors by their names and write the files; returns all bands."""
    subjects = [load(name, overrides) for name in names or DEFAULT_SENSORS]
    folder, renderer = make_folder(out), MitsubaRenderer(samples=samples)
    jobs = [(subject, each) for subject in subjects for each in conditions(subject, quick)]
    rows = [planes.measure(s, renderer, *each) for s, each in shown(jobs, "planes")]
    squares = [edges.measure(s, renderer, 3 if quick else 8) for s in shown(subjects, "edges")]
    return write(subjects, pd.DataFrame(rows), pd.DataFrame(squares), folder)


def write(
    subjects: Sequence[Subject], flat: pd.DataFrame, square: pd.DataFrame, folder: Path
) -> list[Band]:
    """Judge the rows of all sensors, and write them, the bands and the page."""
    bands: list[Band] = []
    for subject in subjects:
        edge = square[square.sensor == subject.name].iloc[0].to_dict()
        bands += judge(subject, flat[flat.sensor == subject.name], edge)
    table = pd.DataFrame([asdict(band) | {"holds": band.holds} for band in bands])
    for name, rows in (("planes", flat), ("edges", square), ("bands", table)):
        write_text(folder / f"{name}.csv", rows.to_csv(index=False, float_format="%.6g"))
    template = files("qs3.calibration").joinpath("bench.md").read_text("utf-8")
    lines = [_line(s.name, flat[flat.sensor == s.name], bands) for s in subjects]
    page = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True)
    text = page.from_string(template).render(
        sensors=lines, bands=bands, depths_m=_SHOWN_M, tilts_deg=_SHOWN_DEG
    )
    write_text(folder / "sensors.md", text + "\n")
    return bands


def _line(name: str, rows: pd.DataFrame, bands: Sequence[Band]) -> dict[str, object]:
    own = [band for band in bands if band.sensor == name]
    facing = rows[rows.tilt_deg == 0]
    sigma, fill = facing.set_index("depth_m").sigma_m, rows.groupby("tilt_deg").fill.mean()
    return {
        "name": name,
        "holds": f"{sum(band.holds for band in own)}/{len(own)}",
        "p": f"{exponent(facing):.2f}",
        "sigma_mm": [f"{1e3 * sigma[z]:.2f}" if z in sigma else "-" for z in _SHOWN_M],
        "fill": [f"{100 * fill[t]:.0f}" if t in fill else "-" for t in _SHOWN_DEG],
    }


@dataclass(frozen=True)
class Band:
    """What is asked of one sensor: `value` within `low` and `high`; NaN is not."""

    sensor: str
    band: str
    value: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """Whether the value lies within the limits."""
        return self.low <= self.value <= self.high


def judge(subject: Subject, flat: pd.DataFrame, edge: dict[str, Any]) -> list[Band]:
    """All bands that apply to a sensor, by rows of `planes.measure` and `edges.measure`.

    A preset by `qs3 fit` is held against what it states itself, which its camera's frames show; the
    others are judged by their names.
    """
    name, sensor = subject.name, subject.sensor
    facing = flat[flat.tilt_deg == 0]
    gentle = flat[flat.tilt_deg <= 45]
    found: list[_Row] = []
    if isinstance(sensor, FittedDepth):
        off = _farthest(gentle.fill - sensor.fill_rate, 0.0)
        found.append(("fill beside the preset's own up to 45 degrees", off, -0.05, 0.05))
    else:
        if subject.focal_baseline is not None:
            near = facing[facing.depth_m <= (max(_D435_M) if "d435" in name else np.inf)]
            found.append(("sigma_Z grows as Z^p: p", exponent(near), 1.8, 2.2))
            found.append(_bias(subject, facing))
        found += _device(name, flat, facing)
        found.append(("fill up to 45 degrees", float(gentle.fill.min()), 0.95, 1.0))
    return [Band(name, *each) for each in found + _edge(edge)]


def exponent(facing: pd.DataFrame) -> float:
    """Exponent p of sigma = a Z^p, by least squares on the logarithms."""
    good = facing[facing.sigma_m > 0]
    if len(good) < 2:
        return np.nan
    return float(np.polyfit(np.log(good.depth_m), np.log(good.sigma_m), 1)[0])


def _farthest(values: pd.Series | np.ndarray, middle: float) -> float:
    values = np.asarray(values, dtype=float)
    if np.isnan(values).all():
        return np.nan
    return float(values[np.nanargmax(np.abs(values - middle))])


def _bias(subject: Subject, facing: pd.DataFrame) -> _Row:
    """Pooled over phases: 0.02 px for a D400, else a quarter of a step of the disparity.

    What a device's calibration leaves is a bias too: of such a sensor the data sheet's is asked.
    """
    sensor: Any = subject.sensor
    if getattr(getattr(sensor, "misalignment", None), "columns_px", 0):
        most, reach = _D400_ACCURACY
        value = _farthest(facing[facing.depth_m <= reach].accuracy, 0.0)
        return f"Z accuracy up to {reach:g} m", value, -most, most
    steps = sensor.quantiser.steps_per_px or getattr(subject.matcher, "steps_per_px", 0)
    limit = 0.02 if "d4" in subject.name else 0.25 / (steps or 16)
    return "median bias of the disparity, px", _farthest(facing.bias_px, 0.0), -limit, limit


def _device(name: str, flat: pd.DataFrame, facing: pd.DataFrame) -> Iterator[_Row]:
    """The published noise and fill of the device that a preset is named for."""
    by_depth = facing.set_index("depth_m")
    if name.startswith("kinect_v1"):
        for z in _NGUYEN_M:
            # Axial noise up to 60 degrees (Nguyen, Izadi and Lovell, 3DIMPVT 2012).
            ratio = by_depth.sigma_m.get(z, np.nan) / (0.0012 + 0.0019 * (z - 0.4) ** 2)
            yield f"sigma_Z at {z:g} m over Nguyen's", float(ratio), 0.7, 1.3
    if "d415" in name:
        for key, (low, high) in _REAL_D415.items():
            yield f"{key} at 1 m, a real D415's", float(by_depth[key].get(1.0, np.nan)), low, high
    elif "d4" in name:
        low, high = _D400_RMS_PX
        near = facing[facing.depth_m <= max(_D435_M)]
        yield "sub-pixel RMS, px", _farthest(near.subpixel_rms_px, (low + high) / 2), low, high
    if "d435" in name:
        near = facing[facing.depth_m.isin(_D435_M)]
        # Axial noise as measured by L. Kotsonis (elevation_mapping, 0.2 to 3.25 m).
        kotsonis_m = 0.000611 + 0.003587 * (near.depth_m - 0.3515) ** 2
        ratio = np.log(near.sigma_m / kotsonis_m)
        yield "sigma_Z over a real D435's (Kotsonis)", float(np.exp(_farthest(ratio, 0))), 0.7, 1.3
    for tilt, (low, high) in _FILL_TILTED.items():
        if "d4" in name and (flat.tilt_deg == tilt).any():  # a quick bench leaves them out
            value = float(flat.fill[flat.tilt_deg == tilt].mean())
            yield f"fill at {tilt:g} degrees", value, low, high


def _edge(edge: dict[str, Any]) -> list[_Row]:
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
