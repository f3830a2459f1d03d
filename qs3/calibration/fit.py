"""A sensor preset from depth images of a flat wall: `qs3 fit --help`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from qs3.calibration.walls import Noise, find_bias, find_noise, find_steps, find_wall
from qs3.datasets.depth_images import check_intrinsics, read_depth, read_intrinsics
from qs3.errors import ConfigError
from qs3.geometry.cameras import Intrinsics
from qs3.utils.pictures import blank, save_png

_NEAREST_M, _FARTHEST_M = 0.3, 8.0  # limits where no wall was seen outside of them
_MOST_BIAS = 0.3  # of a distance: a larger one is of another unit or another frame
_METRES = {"m": 1.0, "mm": 1e-3}


def fit_walls(
    files: Sequence[Path],
    intrinsics: str | None,
    focal: float | None,
    unit: str | None = None,
    distances: Sequence[float] = (),
    baseline: float | None = None,
) -> tuple[str, Noise]:
    """The preset, a file of conf/sensor, and the noise; see `qs3 fit --help` for the arguments."""
    scale_m = None if unit is None else _METRES.get(unit) or 1 / float(unit)
    frames = [read_depth(path, scale_m) for path in files]
    if len({frame.shape for frame in frames}) != 1:
        raise ConfigError("expected depth images of one size: qs3 fit frames/*.png ...")
    height, width = frames[0].shape
    if intrinsics is not None:
        given = read_intrinsics(intrinsics)
        check_intrinsics(given, frames[0], f"{intrinsics=}")
        pinhole = given.camera
        middle_px = (pinhole.fx_px + pinhole.fy_px) / 2
        k = Intrinsics(width, height, middle_px, pinhole.cx_px, pinhole.cy_px)
    elif focal is not None:
        k = Intrinsics.centred(width, height, focal)
    else:
        raise ConfigError("the camera is missing: intrinsics=fx,fy,cx,cy or focal=PIXELS")
    walls = [
        find_wall(str(path), np.where(frame > 0, frame, np.nan), k)
        for path, frame in zip(files, frames, strict=True)
    ]
    bias_m: tuple[float, ...] = (0.0,)
    if distances:
        off = [abs(d - w.centre_m) / w.centre_m for d, w in zip(distances, walls, strict=True)]
        if max(off) > _MOST_BIAS:
            seen = ", ".join(f"{wall.centre_m:.2f}" for wall in walls)
            raise ConfigError(f"distances= of the frames, in metres: the walls are at {seen}")
        bias_m = find_bias(walls, distances)
    steps = find_steps(walls)
    noise = find_noise(walls, steps)
    nearest = min(float(np.nanmin(wall.depth_m)) for wall in walls)
    farthest = max(float(np.nanmax(wall.depth_m)) for wall in walls)
    text = f"""\
# Fitted to depth images of a flat wall from {nearest:.2f} to {farthest:.2f} m; beyond, noise, steps
# and bias are extrapolated. Noise is added to the true depth.
_target_: qs3.sensors.devices.fitted.FittedDepth
width_px: {k.width_px}
height_px: {k.height_px}
focal_px: {k.focal_px:.8g}
cx_px: {k.cx_px:.8g}
cy_px: {k.cy_px:.8g}
min_depth_m: {min(_NEAREST_M, nearest / 1.5):.2g}
max_depth_m: {max(_FARTHEST_M, farthest * 1.5):.2g}
noise_floor_m: {noise.floor_m:.6g}
noise_factor: {noise.factor:.6g}
noise_power: {noise.power:g}
correlation_px: {noise.correlation_px:.3g}
inverse_step_per_m: {steps.inverse_per_m:.8g}
depth_step_m: {steps.depth_m:.6g}
bias_m: [{", ".join(f"{value:.6g}" for value in bias_m)}]
fill_rate: {np.mean([wall.fill for wall in walls]):.4g}
baseline_m: {"null" if baseline is None else f"{baseline:.6g}"}
"""
    return text, noise


def plot_noise(noise: Noise, path: Path) -> None:
    """A picture of the noise against the distance: data and law."""
    figure = blank(6.4, 4.2, 110, constrained=True)
    axes = figure.subplots()
    z = np.linspace(0.9 * noise.depth_m.min(), 1.1 * noise.depth_m.max(), 200)
    axes.plot(noise.depth_m, 1e3 * noise.sigma_m, "o", ms=4, label="data")
    law_m = noise.floor_m + noise.factor * z**noise.power
    axes.plot(z, 1e3 * law_m, label="fitted law, without the steps")
    axes.set(xlabel="distance (m)", ylabel="noise (mm)", ylim=(0, None))
    axes.legend(fontsize=8)
    save_png(figure, path)
