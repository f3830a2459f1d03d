"""Known targets before any depth sensor: are its errors those of the device it stands for?

    qs3 bench sensor=kinect_v1,realsense_d435

renders planes and a square before a wall with the sensor's own settings, and measures what comes
back: planes.csv, edges.csv, bands.csv, and a page of them, index.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path

import jinja2
import pandas as pd

from qs3.calibration import edges, planes
from qs3.calibration.bands import Band, exponent, judge
from qs3.calibration.subject import Subject, load
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from qs3.utils.files import make_folder, write_text
from qs3.utils.progress import progress_bar

DEFAULT_SENSORS = (
    "kinect_v1", "structure_sensor", "realsense_d415", "realsense_d435", "speckle_stereo",
    "time_of_flight", "fringe", "kinect_like", "blensor_kinect", "blensor_tof",
)  # fmt: skip
"""On the page. Not on it: copies of others, and those that repeat a defect on purpose."""

PLANES = (
    "sensor", "depth_m", "tilt_deg", "recedes", "pixels", "fill", "sigma_m", "bias_m", "accuracy",
    "plane_rms_m", "subpixel_rms_px", "sigma_px", "bias_px", "outliers",
    "correlation_px", "levels", "levels_expected", "law_m",
)  # fmt: skip
"""Columns of planes.csv; see `planes.measure`."""

_TILTS_DEG = (15, 30, 45, 60, 65, 70, 75, 80, 85)
_TILT_DEPTH_M = 2.0
_SHOWN_M = (0.5, 1.0, 2.0, 3.0, 4.0)
_SHOWN_DEG = (60.0, 75.0, 80.0, 85.0)


def conditions(subject: Subject, quick: bool = False) -> list[planes.PlanarCondition]:
    """Planes at all distances, and tilted both ways at the one nearest to 2 m."""
    phases, half_px = (8, 16) if quick else (16, 24)
    depths = subject.depths_m()
    tilted = min(depths, key=lambda z: abs(z - _TILT_DEPTH_M))
    places = [(z, 0.0, True) for z in depths]
    for along in (True, False):
        places += [(tilted, float(tilt), along) for tilt in ((45, 75) if quick else _TILTS_DEG)]
    return [planes.PlanarCondition(*place, phases, half_px) for place in places]


def run(
    names: Sequence[str], overrides: Sequence[str], quick: bool, samples: int, out: Path
) -> list[Band]:
    """Measure sensors by their names and write the files; returns all bands."""
    subjects = [load(name, overrides) for name in names or DEFAULT_SENSORS]
    folder, renderer = make_folder(out), MitsubaRenderer(samples=samples)
    rows, squares = [], []
    total = sum(len(conditions(subject, quick)) + 1 for subject in subjects)
    with progress_bar("conditions", total=total) as advance:
        for subject in subjects:
            for condition in conditions(subject, quick):
                rows.append(planes.measure(subject, condition, renderer))
                advance()
            squares.append(edges.measure(subject, renderer, 3 if quick else 8))
            advance()
    return write(subjects, pd.DataFrame(rows, columns=PLANES), pd.DataFrame(squares), folder)


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
    shown = [_shown(s.name, flat[flat.sensor == s.name], bands) for s in subjects]
    page = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True)
    text = page.from_string(template).render(
        sensors=shown, bands=bands, depths_m=_SHOWN_M, tilts_deg=_SHOWN_DEG
    )
    write_text(folder / "index.md", text + "\n")
    return bands


def _shown(name: str, rows: pd.DataFrame, bands: Sequence[Band]) -> dict[str, object]:
    """A sensor's line of the page."""
    own = [band for band in bands if band.sensor == name]
    facing = rows[rows.tilt_deg == 0]
    sigma, fill = facing.set_index("depth_m").sigma_m, rows.groupby("tilt_deg").fill.mean()
    return {
        "name": name,
        "holds": f"{sum(band.holds for band in own)} of {len(own)}",
        "p": f"{exponent(facing):.2f}",
        "sigma_mm": [f"{1e3 * sigma[z]:.2f}" if z in sigma else "-" for z in _SHOWN_M],
        "fill": [f"{100 * fill[t]:.0f}" if t in fill else "-" for t in _SHOWN_DEG],
    }
