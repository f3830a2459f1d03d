"""The bench as pictures: our sensors as points and lines, published laws in grey."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qs3.sensors.bench import bands, laws
from qs3.sensors.bench.runner import SensorResult
from qs3.utils.plotting import GRID, blank, save_png

_COLOURS = (
    "#1f6fb2",
    "#d1495b",
    "#2a9d62",
    "#8a4fbf",
    "#e08e1b",
    "#15a3a8",
    "#6b4f3a",
    "#b03a8c",
    "#5c6b1f",
    "#7d8796",
)
_MARKERS = "osD^vPX<>*"
_DPI = 90


def draw_all(results: Sequence[SensorResult], folder: Path) -> dict[str, str]:
    """All figures.

    Returns:
        File name -> caption, in the order of the page.
    """
    styles = {
        r.subject.name: {"color": _COLOURS[i % 10], "marker": _MARKERS[i % 10], "markersize": 5}
        for i, r in enumerate(results)
    }
    kinects = [r for r in results if _family(r) == "kinect"]
    d400 = [r for r in results if _family(r) == "d400"]
    others = [r for r in results if _family(r) == "other"]
    triangulating = [r for r in results if r.subject.focal_baseline is not None]
    out: dict[str, str] = {}
    if kinects:
        out["noise-kinect.png"] = (
            "Axial noise of the Kinect-like sensors before a plane that faces them, beside "
            "Nguyen 2012 (band: 30 %) and Khoshelham 2012."
        )
        _noise(kinects, styles, folder / "noise-kinect.png", _kinect_laws)
    if d400:
        out["noise-d400.png"] = (
            "Axial noise of the D400 presets beside Intel's formula Z^2 s / (f B) with "
            "s = 0.08 px (band: s = 0.03 to 0.10 px) and Kotsonis' measurement of a D435."
        )
        _noise(d400, styles, folder / "noise-d400.png", lambda axes: _intel_laws(axes, d400))
    if others:
        out["noise-others.png"] = (
            "Axial noise of the other sensors; dashed: the law that a sensor states itself, "
            "where it does."
        )
        _noise(others, styles, folder / "noise-others.png", lambda axes: _own_laws(axes, others))
    if triangulating:
        out["subpixel.png"] = (
            "Sub-pixel RMS, which does not depend on geometry; grey: what we allow a D400; "
            "dashed: what Intel calls possible and what it tells users to count on."
        )
        _subpixel(triangulating, styles, folder / "subpixel.png")
    out["fill.png"] = (
        "Fill rate against tilt, along the baseline (full) and across it (dashed). Dotted "
        "vertical lines: where the disparity changes by 2 px across the window."
    )
    _fill(results, styles, folder / "fill.png")
    if triangulating:
        out["tilt.png"] = (
            "Error of the disparity against tilt. It grows where the window no longer fits the "
            "ramp; grey: Nguyen's axial noise of Kinect v1 as a disparity."
        )
        _tilt(triangulating, styles, folder / "tilt.png")
        out["locking.png"] = (
            "Pixel locking: median error of the disparity against the fraction of a pixel of the "
            "true one, all distances. A matcher that prefers whole pixels makes a wave."
        )
        _locking(triangulating, styles, folder / "locking.png")
        out["histogram.png"] = (
            "Measured disparities by their fraction of a pixel, over planes spread evenly: flat "
            "but for the quantiser's comb if nothing is preferred."
        )
        _histogram(triangulating, styles, folder / "histogram.png")
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


def _depths(result: SensorResult, key: str) -> tuple[np.ndarray, np.ndarray]:
    found = [m for m in result.facing() if m.get(key) is not None]
    return (
        np.array([m["condition"]["depth_m"] for m in found]),
        np.array([m[key] for m in found]),
    )


def _noise(results: Sequence[SensorResult], styles: dict, path: Path, draw_laws: Any) -> None:
    figure, axes = _axes()
    for result in results:
        depth, sigma = _depths(result, "sigma_m")
        p, _ = bands.exponent(result)
        label = f"{result.subject.name}, Z^{p:.2f}"
        axes.plot(depth, 1e3 * sigma, label=label, **styles[result.subject.name])
    axes.set_xscale("log")
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    draw_laws(axes)
    axes.set_ylim(low * 0.7, high * 1.4)
    ticks = [0.3, 0.5, 0.7, 1, 1.5, 2, 3, 4, 5]
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel("distance Z (m)")
    axes.set_ylabel("axial noise sigma_Z (mm)")
    axes.legend(fontsize=8)
    save_png(figure, path)


def _kinect_laws(axes: Any) -> None:
    z = np.geomspace(0.7, 5, 60)
    nguyen = 1e3 * laws.nguyen_axial_m(z)
    axes.fill_between(z, 0.7 * nguyen, 1.3 * nguyen, color="#d8dbe0", zorder=0)
    axes.plot(z, nguyen, color="#555a63", label="Nguyen 2012 (real Kinect v1)")
    axes.plot(
        z, 1e3 * laws.khoshelham_m(z), color="#555a63", ls="--", label="Khoshelham 2012 (real)"
    )


def _intel_laws(axes: Any, results: Sequence[SensorResult]) -> None:
    z = np.geomspace(0.3, 5, 60)
    for result in results:
        sensor: Any = result.subject.sensor
        f, b = sensor.focal_px, sensor.baseline_m
        low, high = (1e3 * laws.triangulation_m(z, f, b, s) for s in laws.D400_BAND_PX)
        axes.fill_between(z, low, high, color="#d8dbe0", alpha=0.7, zorder=0)
        name = result.subject.name.removeprefix("realsense_")
        style = "-" if "435" in name else "--"
        count_on = 1e3 * laws.triangulation_m(z, f, b, laws.INTEL_SUBPIXEL_PX[1])
        axes.plot(z, count_on, color="#555a63", ls=style, label=f"Intel's formula, {name}, 0.08 px")
    near = z[z < 3.25]
    axes.plot(
        near,
        1e3 * laws.kotsonis_d435_m(near),
        color="#555a63",
        ls=":",
        label="Kotsonis (real D435)",
    )


def _own_laws(axes: Any, results: Sequence[SensorResult]) -> None:
    for i, result in enumerate(results):
        depth, law = _depths(result, "law_m")
        if len(depth):
            label = "stated by the sensor" if i == 0 else None
            axes.plot(depth, 1e3 * law, color="#555a63", ls="--", label=label)


def _subpixel(results: Sequence[SensorResult], styles: dict, path: Path) -> None:
    figure, axes = _axes()
    axes.axhspan(*laws.D400_BAND_PX, color="#d8dbe0", zorder=0)
    for told in laws.INTEL_SUBPIXEL_PX:
        axes.axhline(told, color="#555a63", ls="--", linewidth=0.9)
    for result in results:
        depth, value = _depths(result, "subpixel_rms_px")
        axes.plot(depth, value, label=result.subject.name, **styles[result.subject.name])
    axes.set_ylim(0, None)
    axes.set_xlabel("distance Z (m)")
    axes.set_ylabel("sub-pixel RMS (px)")
    axes.legend(fontsize=8, ncols=2)
    save_png(figure, path)


def _tilts(result: SensorResult, across: bool, key: str) -> tuple[np.ndarray, np.ndarray]:
    found = [m for m in result.tilted(across) if m.get(key) is not None]
    return (
        np.array([m["condition"]["tilt_deg"] for m in found]),
        np.array([m[key] for m in found]),
    )


def _fill(results: Sequence[SensorResult], styles: dict, path: Path) -> None:
    figure, axes = _axes()
    for result in results:
        name, subject = result.subject.name, result.subject
        style = styles[name]
        tilt, fill = _tilts(result, True, "fill")
        axes.plot(tilt, 100 * fill, label=name, **style)
        tilt, fill = _tilts(result, False, "fill")
        axes.plot(tilt, 100 * fill, ls="--", linewidth=0.9, color=style["color"])
        rows = result.tilted(True)
        if subject.window_px and subject.baseline_m and rows:
            depth = rows[0]["condition"]["depth_m"]
            angle = laws.ramp_angle_deg(subject.window_px, subject.baseline_m, depth, 2)
            axes.axvline(angle, color=style["color"], ls=":", linewidth=1)
    axes.axhline(95, color="#555a63", linewidth=0.8)
    axes.set_xlim(40, 87)  # nothing happens before
    axes.set_ylim(0, 103)
    axes.set_xlabel("tilt of the plane (degrees)")
    axes.set_ylabel("fill rate (%)")
    axes.legend(fontsize=8, loc="lower left")
    save_png(figure, path)


def _tilt(results: Sequence[SensorResult], styles: dict, path: Path) -> None:
    figure, axes = _axes()
    for result in results:
        tilt, sigma = _tilts(result, True, "sigma_px")
        axes.plot(tilt, sigma, label=result.subject.name, **styles[result.subject.name])
    angles = np.linspace(0, 82, 83)
    nguyen = np.array([float(laws.nguyen_axial_m(2.0, float(a))) for a in angles])
    axes.plot(angles, nguyen * 580 * 0.075 / 4, color="#555a63", label="Nguyen 2012 at 2 m")
    axes.set_ylim(0, 0.5)
    axes.set_xlabel("tilt of the plane along the baseline (degrees)")
    axes.set_ylabel("error of the disparity, one sigma (px)")
    axes.legend(fontsize=8, loc="upper left")
    save_png(figure, path)


def _grid(count: int, height: float) -> tuple[Any, list[Any]]:
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = blank(2.9 * columns, height * rows, _DPI, constrained=True)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    for unused in axes[count:]:
        unused.set_axis_off()
    return figure, list(axes[:count])


def _locking(results: Sequence[SensorResult], styles: dict, path: Path) -> None:
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
    save_png(figure, path)


def _histogram(results: Sequence[SensorResult], styles: dict, path: Path) -> None:
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
        axes.axhline(1, color="#555a63", linewidth=0.8)
        axes.set_title(result.subject.name, fontsize=9)
        axes.tick_params(labelsize=8)
    figure.supxlabel("fraction of the measured disparity (px)", fontsize=9)
    figure.supylabel("density (1: even)", fontsize=9)
    save_png(figure, path)


def draw_real(
    real: np.ndarray,
    simulated: np.ndarray,
    runs: tuple[np.ndarray, np.ndarray],
    path: Path,
) -> None:
    """Real beside simulated: depth images, depth steps, lengths of holes.

    Args:
        real, simulated: [480, 640] depth images in metres with NaN.
        runs: lengths of all holes in px, real and simulated.
    """
    figure = blank(8.6, 6.4, _DPI, constrained=True)
    panels = figure.subplots(2, 2)
    names = ("REAL Kinect v1", "SIMULATED, kinect_v1")
    for axes, depth, name in zip(panels[0], (real, simulated), names, strict=True):
        axes.imshow(depth, vmin=0.55, vmax=1.35, cmap="viridis")
        axes.set_title(name + " (white: no depth)", fontsize=10)
        axes.set_xlabel("column (px)", fontsize=8)
        axes.set_ylabel("row (px)", fontsize=8)
        axes.tick_params(labelsize=7)
    figure.colorbar(panels[0][0].images[0], ax=list(panels[0]), label="depth (m)", shrink=0.85)
    steps, holes = panels[1]
    for depth, name, colour, marker in zip(
        (real, simulated), names, (_COLOURS[0], _COLOURS[1]), "ox", strict=True
    ):
        values = depth[np.isfinite(depth) & (depth > 0.8) & (depth < 1.3)].astype(np.float64)
        unique = np.unique(np.rint(values * 1000)) / 1000
        steps.plot(
            unique[:-1], 1e3 * np.diff(unique), ls="", marker=marker, ms=3, color=colour, label=name
        )
    z = np.linspace(0.8, 1.3, 50)
    steps.plot(z, 1e3 * z**2 / (8 * 43.5), color="#555a63", label="1/8 px: Z^2 / (8 f B)")
    steps.set_ylim(0, 12)
    steps.set_xlabel("depth (m); the files have whole millimetres")
    steps.set_ylabel("step to the next depth (mm)")
    steps.legend(fontsize=8)
    bins = np.arange(0.5, 31.5, 1)
    for found, name, colour in zip(runs, names, (_COLOURS[0], _COLOURS[1]), strict=True):
        share = np.histogram(found, bins=bins)[0] / max(len(found), 1)
        holes.step(bins[:-1] + 0.5, 100 * share, where="mid", color=colour, label=name)
    holes.set_xlabel("length of a hole along a row (px)")
    holes.set_ylabel("share of all holes (%)")
    holes.legend(fontsize=8)
    save_png(figure, path)
