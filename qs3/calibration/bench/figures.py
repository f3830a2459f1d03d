"""The bench as pictures: our sensors as points and lines, published laws in grey."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from qs3.calibration.bench import bands, laws
from qs3.calibration.bench.runner import SensorResult
from qs3.utils.plotting import GRID, blank, save_png

_COLOURS = [
    "#1f6fb2", "#d1495b", "#2a9d62", "#8a4fbf", "#e08e1b",
    "#15a3a8", "#6b4f3a", "#b03a8c", "#5c6b1f", "#7d8796",
]  # fmt: skip
_MARKERS = "osD^vPX<>*"
_LAW, _BAND = "#555a63", "#d8dbe0"
_DPI = 90

Results = Sequence[SensorResult]
_CAPTIONS = {
    "noise-kinect": "Axial noise of the Kinect-like sensors before a plane that faces them, next "
    "to Nguyen 2012 (band: 30 %) and Khoshelham 2012.",
    "noise-d400": "Axial noise of the D400 presets next to Intel's formula Z^2 s / (f B) with "
    "s = 0.08 px (band: s = 0.03 to 0.10 px) and Kotsonis' measurement of a D435.",
    "noise-others": "Axial noise of the other sensors; dashed: the law that a sensor states "
    "itself, where it does.",
    "subpixel": "Sub-pixel RMS, which does not depend on geometry; grey: what we allow a D400; "
    "dashed: what Intel calls possible and what it tells users to count on.",
    "fill": "Fill rate against tilt, along the baseline (full) and across it (dashed). Dotted "
    "vertical lines: where the disparity changes by 2 px across the window.",
    "tilt": "Error of the disparity against tilt. It grows where the window no longer fits the "
    "ramp; grey: Nguyen's axial noise of Kinect v1 as a disparity.",
    "locking": "Pixel locking: median error of the disparity against the fraction of a pixel of "
    "the true one, all distances. A matcher that prefers whole pixels makes a wave.",
    "histogram": "Measured disparities by their fraction of a pixel, over planes spread evenly: "
    "flat but for the quantiser's comb if nothing is preferred.",
}


def draw_all(results: Results, folder: Path) -> dict[str, str]:
    """Draw all figures that apply.

    Returns:
        File name -> caption, in the order of the page.
    """
    styles = {
        r.subject.name: {"color": _COLOURS[i % 10], "marker": _MARKERS[i % 10], "markersize": 5}
        for i, r in enumerate(results)
    }
    kinects, d400, others = (
        [r for r in results if _family(r) == family] for family in ("kinect", "d400", "other")
    )
    triangulating = [r for r in results if r.subject.focal_baseline is not None]
    figures: dict[str, tuple[Results, Callable]] = {
        "noise-kinect": (kinects, partial(_noise, draw_laws=_kinect_laws)),
        "noise-d400": (d400, partial(_noise, draw_laws=_intel_laws)),
        "noise-others": (others, partial(_noise, draw_laws=_own_laws)),
        "subpixel": (triangulating, _subpixel),
        "fill": (results, _fill),
        "tilt": (triangulating, _tilt),
        "locking": (triangulating, _locking),
        "histogram": (triangulating, _histogram),
    }
    out = {}
    for name, (shown, draw) in figures.items():
        if shown:
            save_png(draw(shown, styles), folder / f"{name}.png")
            out[f"{name}.png"] = _CAPTIONS[name]
    return out


def _family(result: SensorResult) -> str:
    name = result.subject.name
    if "d4" in name:
        return "d400"
    return "kinect" if name.startswith(("kinect", "structure")) else "other"


def _axes(width: float = 6.4, height: float = 4.2) -> tuple[Any, Any]:
    figure = blank(width, height, _DPI, constrained=True)
    axes = figure.subplots()
    axes.grid(True, which="both", color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    return figure, axes


def _series(rows: Sequence[dict], at: str, key: str) -> tuple[np.ndarray, np.ndarray]:
    """Values of a condition's key and of a result's, where there is one."""
    found = [m for m in rows if m.get(key) is not None]
    return np.array([m["condition"][at] for m in found]), np.array([m[key] for m in found])


def _noise(results: Results, styles: dict, draw_laws: Callable) -> Any:
    figure, axes = _axes()
    for result in results:
        depth, sigma = _series(result.facing(), "depth_m", "sigma_m")
        p, _ = bands.exponent(result)
        label = f"{result.subject.name}, Z^{p:.2f}"
        axes.plot(depth, 1e3 * sigma, label=label, **styles[result.subject.name])
    axes.set(xscale="log", yscale="log")
    low, high = axes.get_ylim()
    draw_laws(axes, results)
    axes.set_ylim(low * 0.7, high * 1.4)
    ticks = [0.3, 0.5, 0.7, 1, 1.5, 2, 3, 4, 5]
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set(xlabel="distance Z (m)", ylabel="axial noise sigma_Z (mm)")
    axes.legend(fontsize=8)
    return figure


def _kinect_laws(axes: Any, results: Results) -> None:
    z = np.geomspace(0.7, 5, 60)
    nguyen = 1e3 * laws.nguyen_axial_m(z)
    axes.fill_between(z, 0.7 * nguyen, 1.3 * nguyen, color=_BAND, zorder=0)
    axes.plot(z, nguyen, color=_LAW, label="Nguyen 2012 (real Kinect v1)")
    axes.plot(z, 1e3 * laws.khoshelham_m(z), color=_LAW, ls="--", label="Khoshelham 2012 (real)")


def _intel_laws(axes: Any, results: Results) -> None:
    z = np.geomspace(0.3, 5, 60)
    for result in results:
        sensor: Any = result.subject.sensor
        f, b = sensor.focal_px, sensor.baseline_m
        low, high = (1e3 * laws.triangulation_m(z, f, b, s) for s in laws.D400_BAND_PX)
        axes.fill_between(z, low, high, color=_BAND, alpha=0.7, zorder=0)
        name = result.subject.name.removeprefix("realsense_")
        style = "-" if "435" in name else "--"
        count_on = 1e3 * laws.triangulation_m(z, f, b, laws.INTEL_SUBPIXEL_PX[1])
        axes.plot(z, count_on, color=_LAW, ls=style, label=f"Intel's formula, {name}, 0.08 px")
    near = z[z < 3.25]
    axes.plot(
        near, 1e3 * laws.kotsonis_d435_m(near), color=_LAW, ls=":", label="Kotsonis (real D435)"
    )


def _own_laws(axes: Any, results: Results) -> None:
    for i, result in enumerate(results):
        depth, law = _series(result.facing(), "depth_m", "law_m")
        if len(depth):
            label = "stated by the sensor" if i == 0 else None
            axes.plot(depth, 1e3 * law, color=_LAW, ls="--", label=label)


def _subpixel(results: Results, styles: dict) -> Any:
    figure, axes = _axes()
    axes.axhspan(*laws.D400_BAND_PX, color=_BAND, zorder=0)
    for stated in laws.INTEL_SUBPIXEL_PX:
        axes.axhline(stated, color=_LAW, ls="--", linewidth=0.9)
    for result in results:
        depth, value = _series(result.facing(), "depth_m", "subpixel_rms_px")
        axes.plot(depth, value, label=result.subject.name, **styles[result.subject.name])
    axes.set(ylim=(0, None), xlabel="distance Z (m)", ylabel="sub-pixel RMS (px)")
    axes.legend(fontsize=8, ncols=2)
    return figure


def _fill(results: Results, styles: dict) -> Any:
    figure, axes = _axes()
    for result in results:
        name, subject = result.subject.name, result.subject
        style = styles[name]
        tilt, fill = _series(result.tilted(True), "tilt_deg", "fill")
        axes.plot(tilt, 100 * fill, label=name, **style)
        tilt, fill = _series(result.tilted(False), "tilt_deg", "fill")
        axes.plot(tilt, 100 * fill, ls="--", linewidth=0.9, color=style["color"])
        rows = result.tilted(True)
        if subject.window_px and subject.baseline_m and rows:
            depth = rows[0]["condition"]["depth_m"]
            angle = laws.ramp_angle_deg(subject.window_px, subject.baseline_m, depth, 2)
            axes.axvline(angle, color=style["color"], ls=":", linewidth=1)
    axes.axhline(95, color=_LAW, linewidth=0.8)
    axes.set_xlim(40, 87)  # nothing happens before
    axes.set(ylim=(0, 103), xlabel="tilt of the plane (degrees)", ylabel="fill rate (%)")
    axes.legend(fontsize=8, loc="lower left")
    return figure


def _tilt(results: Results, styles: dict) -> Any:
    figure, axes = _axes()
    for result in results:
        tilt, sigma = _series(result.tilted(True), "tilt_deg", "sigma_px")
        axes.plot(tilt, sigma, label=result.subject.name, **styles[result.subject.name])
    angles = np.linspace(0, 82, 83)
    nguyen = np.array([float(laws.nguyen_axial_m(2.0, float(a))) for a in angles])
    axes.plot(angles, nguyen * 580 * 0.075 / 4, color=_LAW, label="Nguyen 2012 at 2 m")
    axes.set(
        ylim=(0, 0.5),
        xlabel="tilt of the plane along the baseline (degrees)",
        ylabel="error of the disparity, one sigma (px)",
    )
    axes.legend(fontsize=8, loc="upper left")
    return figure


def _grid(count: int, height: float) -> tuple[Any, list[Any]]:
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = blank(2.9 * columns, height * rows, _DPI, constrained=True)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    for unused in axes[count:]:
        unused.set_axis_off()
    return figure, list(axes[:count])


def _locking(results: Results, styles: dict) -> Any:
    figure, panels = _grid(len(results), 2.1)
    for axes, result in zip(panels, results, strict=True):
        facing = result.facing()
        phase = np.concatenate([m["phase"] for m in facing])
        bias = np.array([np.nan if b is None else b for m in facing for b in m["phase_bias_px"]])
        style = styles[result.subject.name]
        axes.axhline(0, color="#9aa0a8", linewidth=0.8)
        axes.plot(phase, bias, ls="", marker=".", markersize=4, color=style["color"])
        amplitude = float(np.mean([m["locking_px"] or 0 for m in facing]))
        axes.set_title(f"{result.subject.name}\nwave {amplitude:.3f} px", fontsize=9)
        reach = max(0.05, 1.15 * float(np.nanmax(np.abs(bias))))
        axes.set_ylim(-reach, reach)
        axes.tick_params(labelsize=8)
    figure.supxlabel("fraction of the true disparity (px)", fontsize=9)
    figure.supylabel("median error (px)", fontsize=9)
    return figure


def _histogram(results: Results, styles: dict) -> Any:
    figure, panels = _grid(len(results), 1.8)
    for axes, result in zip(panels, results, strict=True):
        counts = np.mean([m["phase_histogram"] for m in result.facing()], axis=0)
        bins = len(counts)
        axes.bar(
            np.arange(bins) / bins,
            counts * bins,
            width=1 / bins,
            color=styles[result.subject.name]["color"],
        )
        axes.axhline(1, color=_LAW, linewidth=0.8)
        axes.set_title(result.subject.name, fontsize=9)
        axes.tick_params(labelsize=8)
    figure.supxlabel("fraction of the measured disparity (px)", fontsize=9)
    figure.supylabel("density (1: even)", fontsize=9)
    return figure


def draw_real(
    real: np.ndarray, simulated: np.ndarray, runs: tuple[np.ndarray, np.ndarray], path: Path
) -> None:
    """Real clouds and simulated ones: depth images, depth steps, lengths of holes.

    Args:
        real, simulated: [480, 640] depth images in metres with NaN.
        runs: lengths of all holes in px, real and simulated.
    """
    figure = blank(8.6, 6.4, _DPI, constrained=True)
    panels = figure.subplots(2, 2)
    steps, holes = panels[1]
    bins = np.arange(0.5, 31.5, 1)
    both = (("REAL Kinect v1", real, "o"), ("SIMULATED, kinect_v1", simulated, "x"))
    for axes, (name, depth, marker), found, colour in zip(
        panels[0], both, runs, _COLOURS[:2], strict=True
    ):
        axes.imshow(depth, vmin=0.55, vmax=1.35, cmap="viridis")
        axes.set_title(name + " (white: no depth)", fontsize=10)
        axes.set_xlabel("column (px)", fontsize=8)
        axes.set_ylabel("row (px)", fontsize=8)
        axes.tick_params(labelsize=7)
        values = depth[np.isfinite(depth) & (depth > 0.8) & (depth < 1.3)].astype(np.float64)
        levels = np.unique(np.rint(values * 1000)) / 1000
        style = {"ls": "", "marker": marker, "ms": 3, "color": colour, "label": name}
        steps.plot(levels[:-1], 1e3 * np.diff(levels), **style)
        share = np.histogram(found, bins=bins)[0] / max(len(found), 1)
        holes.step(bins[:-1] + 0.5, 100 * share, where="mid", color=colour, label=name)
    figure.colorbar(panels[0][0].images[0], ax=list(panels[0]), label="depth (m)", shrink=0.85)
    z = np.linspace(0.8, 1.3, 50)
    steps.plot(z, 1e3 * z**2 / (8 * 43.5), color=_LAW, label="1/8 px: Z^2 / (8 f B)")
    steps.set(
        ylim=(0, 12),
        xlabel="depth (m); the files have whole millimetres",
        ylabel="step to the next depth (mm)",
    )
    steps.legend(fontsize=8)
    holes.set(xlabel="length of a hole along a row (px)", ylabel="share of all holes (%)")
    holes.legend(fontsize=8)
    save_png(figure, path)
