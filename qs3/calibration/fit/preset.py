"""A fitted preset as a file under conf/sensor, and the picture of data and model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.calibration.fit.fill import Fill
from qs3.calibration.fit.noise import Noise
from qs3.calibration.fit.planes import Wall
from qs3.calibration.fit.steps import Steps
from qs3.geometry.cameras import Intrinsics
from qs3.utils.files import write_text
from qs3.utils.plotting import blank, save_png

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NEAREST_M, _FARTHEST_M = 0.3, 8.0  # limits where no wall was seen outside of them
_AROUND = 1.5  # else times as near or as far as one was seen


@dataclass(frozen=True, eq=False)
class FittedPreset:
    """All that was found.

    Attributes:
        camera: of the frames.
        noise, steps, fill: see the modules that find them.
        bias_m: coefficients, see FittedDepth; None where no distances were given.
        baseline_m: as given; None if it was not.
        walls: the data.
        doubts: see qs3.calibration.fit.doubts; printed, and written into the preset.
    """

    camera: Intrinsics
    noise: Noise
    steps: Steps
    fill: Fill
    bias_m: tuple[float, ...] | None
    baseline_m: float | None
    walls: Sequence[Wall]
    doubts: Sequence[str] = ()

    def save(self, path: Path, command: str) -> None:
        """Write the preset, with the command that made it."""
        k, noise, (nearest, farthest) = self.camera, self.noise, self._range()
        least, most = self.limits_m()
        assumed = "" if noise.power_known else "   # assumed: all walls are equally far"
        baseline = "null" if self.baseline_m is None else f"{self.baseline_m:.6g}"
        doubts = "".join(f"# doubtful: {doubt}\n" for doubt in self.doubts)
        text = f"""\
# Fitted to depth frames of a flat wall; noise is added to the true depth.
# {command}
{doubts}_target_: qs3.sensors.devices.fitted.FittedDepth
width_px: {k.width_px}
height_px: {k.height_px}
focal_px: {k.focal_px:.8g}
cx_px: {k.cx_px:.8g}
cy_px: {k.cy_px:.8g}
step_px: 1
# The frames show walls from {nearest:.2f} to {farthest:.2f} m; beyond that noise, steps and bias
# are extrapolated.
min_depth_m: {least:g}
max_depth_m: {most:g}
noise_floor_m: {noise.floor_m:.6g}
noise_factor: {noise.factor:.6g}
noise_power: {noise.power:g}{assumed}
correlation_px: {noise.correlation_px:.3g}
inverse_step_per_m: {self.steps.inverse_per_m:.8g}
depth_step_m: {self.steps.depth_m:.6g}
bias_m: {_numbers(self.bias_m or (0.0,))}
tilts_deg: {_numbers(self.fill.tilts_deg)}
fill_rates: {_numbers(self.fill.rates)}
hole_px: {self.fill.hole_px:.3g}
baseline_m: {baseline}
"""
        write_text(path, text)

    def summary(self) -> list[str]:
        """What was found, a line each."""
        noise, steps, (nearest, farthest) = self.noise, self.steps, self._range()
        floor = f"{1e3 * noise.floor_m:.2f} mm + " if noise.floor_m else ""
        lines = [
            f"walls     seen from {nearest:.2f} to {farthest:.2f} m; beyond that the preset "
            "extrapolates",
            f"noise     sigma(Z) = {floor}{1e3 * noise.factor:.3f} mm (Z / m)^{noise.power:g}"
            + ("" if noise.power_known else "; the power is assumed, walls are equally far"),
            f"          smooth over {noise.correlation_px:.2f} px",
        ]
        if steps.inverse_per_m:
            lines.append(
                f"steps     {steps.inverse_per_m:.6f} 1/m of 1/Z, so "
                f"{1e3 * steps.inverse_per_m:.2f} mm at 1 m; eighths of a pixel if f b = "
                f"{1 / (8 * steps.inverse_per_m):.2f} px m"
            )
        if steps.depth_m:
            lines.append(f"          {1e3 * steps.depth_m:.3g} mm of depth")
        if not steps.inverse_per_m and not steps.depth_m:
            lines.append("steps     none seen")
        rates = ", ".join(
            f"{100 * rate:.1f} % at {tilt:.0f} deg"
            for tilt, rate in zip(self.fill.tilts_deg, self.fill.rates, strict=True)
        )
        lines.append(f"fill      {rates}")
        lines.append(
            "bias      " + (f"{_numbers(self.bias_m)} m (constant first)" if self.bias_m else
            "unknown, taken as 0: give the true distances with distances=")
        )  # fmt: skip
        return lines + [f"doubtful  {doubt}" for doubt in self.doubts]

    def plot(self, path: Path) -> None:
        """Four panels: noise, steps, residuals of one frame, fill."""
        figure = blank(10, 7.5, 110, constrained=True)
        axes: Any = figure.subplots(2, 2)
        self._plot_noise(axes[0, 0])
        self._plot_steps(axes[0, 1])
        self._plot_residual(figure, axes[1, 0])
        self._plot_fill(axes[1, 1])
        save_png(figure, path)

    def limits_m(self) -> tuple[float, float]:
        """Depths that the preset keeps: 0.3 to 8 m, and all that a wall was seen at."""
        z = [wall.depth_m[wall.on_wall] for wall in self.walls]
        nearest, farthest = min(map(np.min, z)), max(map(np.max, z))
        # A margin, so that noise about the nearest and farthest pixel is kept, too.
        least = _NEAREST_M if nearest > _NEAREST_M else float(f"{nearest / _AROUND:.2g}")
        most = _FARTHEST_M if farthest < _FARTHEST_M else float(f"{farthest * _AROUND:.2g}")
        return least, most

    def _range(self) -> tuple[float, float]:
        z = np.concatenate([wall.depth_m[wall.on_wall] for wall in self.walls])
        low, high = np.quantile(z, [0.01, 0.99])
        return float(low), float(high)

    def _plot_noise(self, ax: Any) -> None:
        low, high = self._range()
        z = np.linspace(0.9 * low, 1.1 * high, 200)
        law = self.noise.law_m(z)
        ax.plot(self.noise.depth_m, 1e3 * self.noise.sigma_m, "o", ms=4, label="data")
        ax.plot(z, 1e3 * np.hypot(law, self.steps.rounding_m(z)), label="model with quantiser")
        ax.plot(z, 1e3 * law, "--", label="model before it")
        nguyen = 0.0012 + 0.0019 * (z - 0.4) ** 2
        ax.plot(z, 1e3 * nguyen, ":", color="grey", label="Kinect v1, Nguyen 2012")
        ax.set(xlabel="distance (m)", ylabel="noise (mm)", title="Noise against distance")
        ax.set_ylim(bottom=0)
        ax.legend(fontsize=8)

    def _plot_steps(self, ax: Any) -> None:
        values = np.concatenate([wall.depth_m[wall.on_wall] for wall in self.walls])
        levels = np.unique(np.round(values, 5))
        ax.set(xlabel="distance (m)", ylabel="gap to the next level (mm)", title="Steps of depth")
        if len(levels) > 0.3 * len(values):
            ax.text(0.5, 0.5, "no steps seen", ha="center", transform=ax.transAxes)
            return
        gaps = np.diff(levels)
        between = np.sqrt(levels[1:] * levels[:-1])  # where a step s of 1 / Z is s Z^2
        ax.plot(between, 1e3 * gaps, ".", ms=4, label="data")
        z = np.linspace(levels[0], levels[-1], 200)
        if self.steps.inverse_per_m:
            ax.plot(z, 1e3 * self.steps.inverse_per_m * z**2, label="constant step of 1 / Z")
        elif self.steps.depth_m:
            ax.plot(z, np.full_like(z, 1e3 * self.steps.depth_m), label="constant step of Z")
        ax.set_ylim(0, 1e3 * 4 * float(np.median(gaps)))
        ax.legend(fontsize=8)

    def _plot_residual(self, figure: Figure, ax: Any) -> None:
        wall = self.walls[0]
        error = 1e3 * np.where(wall.on_wall, wall.depth_m - wall.plane_m, np.nan)
        reach = float(np.nanquantile(np.abs(error), 0.98))
        picture = ax.imshow(error, cmap="RdBu", vmin=-reach, vmax=reach)
        ax.set(xlabel="column (px)", ylabel="row (px)", title=f"Measured minus plane: {wall.name}")
        ax.set_facecolor("0.85")
        figure.colorbar(picture, ax=ax, label="mm (grey: no depth, or not on the wall)")

    def _plot_fill(self, ax: Any) -> None:
        fill = self.fill
        ax.plot(fill.seen_deg, 100 * np.array(fill.seen_rates), "o", ms=4, label="data")
        tilt = np.linspace(0, 90, 181)
        rate = np.interp(tilt, fill.tilts_deg, fill.rates)
        ax.plot(tilt, 100 * rate, label="model")
        ax.set(xlabel="angle of incidence (degrees)", ylabel="valid pixels (%)", title="Fill rate")
        ax.set_ylim(min(90, 100 * min((*fill.rates, *fill.seen_rates)) - 5), 101)
        ax.legend(fontsize=8)


def _numbers(values: Sequence[float]) -> str:
    return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"
