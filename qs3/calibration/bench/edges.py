"""The edge bench: shadows, fattening and lateral noise around a square before a wall.

Shadows are measured on who sees and who lights the wall, so they test geometry alone; fattening
and lateral noise on the disparity map (the depth image of a sensor without one).
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from qs3.calibration.bench import metrics
from qs3.calibration.bench.planar import without_nan
from qs3.calibration.bench.subject import Subject
from qs3.calibration.bench.targets import POSE, SquareBeforeWall
from qs3.errors import ConfigError
from qs3.sensors.base import DepthFrame
from qs3.sensors.renderers.base import Renderer

SIDES = ("left", "right", "top", "bottom")


@dataclass(frozen=True)
class EdgeCondition:
    """A square before a wall.

    Attributes:
        near_m, far_m: depths of square and wall.
        half_px: half the square's side in the image.
        frames: how many, the square elsewhere by fractions of a pixel in each.
    """

    near_m: float
    far_m: float
    half_px: int = 40
    frames: int = 8

    @property
    def name(self) -> str:
        """For file names and messages."""
        return f"edge-{self.near_m:g}m-{self.far_m:g}m"


def default_condition(subject: Subject, frames: int = 8) -> EdgeCondition:
    """Square and wall at depths the sensor reaches, with a shadow of 8 px or more if possible."""
    depths = subject.depths_m()
    near = depths[min(1, len(depths) - 2)]
    far = min((z for z in depths if z > near), key=lambda z: abs(z - 2 * near))
    return EdgeCondition(near, far, frames=frames)


def measure(
    subject: Subject, condition: EdgeCondition, renderer: Renderer, seed: int = 0
) -> dict[str, Any]:
    """Render and measure; see the module.

    Returns:
        Widths in px, next to them `*_expected_px`. Of each side of the square: `fattening`, by
        how much near depths reach beyond it; `wall`, where the wall's depth begins (both are
        about half a window at most where nothing is hidden); `lateral`, the noise of the edge.
    """
    fb = subject.focal_baseline
    k = subject.intrinsics
    depth_ratio = 1 / condition.near_m - 1 / condition.far_m
    shadow = 0.0 if fb is None else fb * depth_ratio
    around = int(np.ceil(abs(shadow))) + subject.margin_px + 20  # a projector may be to the left
    widths, sides, wall = (defaultdict(list) for _ in range(3))
    for i in range(condition.frames):
        place = ((i + 0.5) / condition.frames + 0.13, (0.37 * i) % 1)
        target = SquareBeforeWall(condition.near_m, condition.far_m, condition.half_px, place)
        bodies, box = target.scene(k.focal_px, around)
        rng = np.random.default_rng([seed, i])
        frame = subject.sensor.scan(bodies, box, POSE, renderer, rng, explain=True)
        if frame is None:
            raise ConfigError(f"{condition.name}: the target is outside the sensor's view")
        middle = (condition.near_m + condition.far_m) / 2
        clean, depth = _full(frame, fb, subject)
        for key, image in (("camera", "seen"), ("projector", "lit")):
            if image in frame.images:
                widths[key].append(_shadow(clean, ~frame.images[image], middle))
        widths["hole"].append(_shadow(clean, ~np.isfinite(depth), middle))
        for side in SIDES:
            near, far = _around(side, clean, depth, middle)
            sides[side].append(near)
            wall[side].append(far)
    out: dict[str, Any] = {"condition": asdict(condition), "baseline_shadow_px": shadow}
    for key, found in widths.items():
        left, right = np.concatenate(found).mean(axis=0)
        out[f"{key}_left_px"], out[f"{key}_right_px"] = float(left), float(right)
    if fb is not None:
        out["camera_expected_px"] = shadow
    source_m = subject.source_m(cameras=2 if "camera_left_px" in out else 1)
    if source_m is not None:
        out["projector_expected_px"] = k.focal_px * source_m * depth_ratio
    for side in SIDES:
        out[f"fattening_{side}_px"] = _median(sides[side])
        out[f"wall_{side}_px"] = _median(wall[side])
        out[f"lateral_{side}_px"] = _jitter(sides[side])
    out["half_window_px"] = None if subject.window_px is None else subject.window_px / 2
    out["nguyen_lateral_px"] = 0.8
    return without_nan(out)


def _full(frame: DepthFrame, fb: float | None, subject: Subject) -> tuple[np.ndarray, np.ndarray]:
    """True and measured depth at every pixel, also of a sensor that gives every fourth one."""
    disparity, clean = frame.images.get("disparity"), frame.images.get("clean")
    if disparity is None or clean is None or fb is None or frame.step_px == 1:
        return frame.clean_m, frame.depth_m
    with np.errstate(divide="ignore", invalid="ignore"):
        return clean, (fb / disparity).astype(np.float32)


def _shadow(clean: np.ndarray, dark: np.ndarray, middle_m: float) -> np.ndarray:
    """[rows, 2] dark pixels of the wall, left and right of the square.

    Counted in the rows of the square's inner half, up to the next 5 pixels that are not dark.
    """
    square = clean < middle_m
    rows = np.flatnonzero(square.any(axis=1))
    inner = rows[len(rows) // 4 : -len(rows) // 4]
    out = []
    for row in inner:
        columns = np.flatnonzero(square[row])
        left = dark[row, : columns[0]][::-1]
        right = dark[row, columns[-1] + 1 :]
        out.append([_first_run(left), _first_run(right)])
    return np.array(out, dtype=np.float64).reshape(-1, 2)


def _first_run(dark: np.ndarray) -> int:
    """Dark pixels before 5 in a row are bright; those that fattening fills count as bright."""
    bright = np.convolve(~dark, np.ones(5, dtype=int), mode="valid") == 5
    # Fattening covers the first few: look for the first dark one, then for the end.
    if not dark.any():
        return 0
    start = int(np.argmax(dark))
    ends = np.flatnonzero(bright[start:])
    end = start + int(ends[0]) if len(ends) else len(dark)
    return int(dark[:end].sum())


def _around(
    side: str, clean: np.ndarray, depth: np.ndarray, middle_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """What is measured across one side of the square, for each row or column of it.

    Returns:
        [N] px by which near depths reach beyond the true edge, positive outwards; [N] px from the
        edge to the first five pixels in a row that have the wall's depth. NaN where there is none.
    """
    true, found = (a.T if side in ("top", "bottom") else a for a in (clean, depth))
    if side in ("left", "top"):
        true, found = true[:, ::-1], found[:, ::-1]
    square = true < middle_m
    rows = np.flatnonzero(square.any(axis=1))
    near_px, wall_px = [], []
    with np.errstate(invalid="ignore"):
        near, far = found < middle_m, found >= middle_m
    for row in rows[len(rows) // 4 : -len(rows) // 4]:
        edge = int(np.flatnonzero(square[row])[-1])
        last = None
        for column in range(max(edge - 20, 0), min(edge + 40, len(near[row]))):
            if near[row, column]:
                last = column
            elif last is not None and column - last > 3:
                break
        near_px.append(np.nan if last is None else last - edge)
        beyond = np.convolve(far[row, edge + 1 :], np.ones(5, dtype=int), mode="valid") == 5
        wall_px.append(int(np.argmax(beyond)) if beyond.any() else np.nan)
    return np.array(near_px, dtype=np.float64), np.array(wall_px, dtype=np.float64)


def _median(found: list[np.ndarray]) -> float:
    pooled = np.concatenate(found)
    return metrics.median(pooled[np.isfinite(pooled)])


def _jitter(found: list[np.ndarray]) -> float:
    """Standard deviation of an edge's place along it, pooled over frames: lateral noise."""
    spread = [np.nanstd(values) for values in found if np.isfinite(values).sum() > 3]
    return metrics.rms(np.array(spread))
