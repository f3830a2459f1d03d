"""A sensor and a square in front of a wall: shadows, and how far edges are blurred.

Shadows are measured on who sees and who lights the wall, so they test geometry alone; blur is
measured on the disparity map (the depth image of a sensor without one).
"""

from collections import defaultdict
from typing import Any

import numpy as np

from qs3.calibration.planes import median
from qs3.calibration.subject import POSE, Subject, box_of, quad
from qs3.sensors.renderers.base import Renderer

_HALF_PX = 40  # half the square's side
_IN_A_ROW = np.ones(5, dtype=int)


def measure(subject: Subject, renderer: Renderer, frames: int = 8) -> dict[str, Any]:
    """Render and measure `frames` squares, each elsewhere by fractions of a pixel.

    Returns:
        sensor, near_m, far_m; widths in px of the shadow of the other camera and of the projector,
        `camera_left_px` and so on, and `camera_expected_px`; of the square's open edge (right)
        `reaches_px`, by how much near depths reach beyond it, `wall_px`, where the wall's depth
        begins, and `half_window_px`.
    """
    within = subject.depths_m()
    near_m = within[min(1, len(within) - 2)]
    far_m = min((z for z in within if z > near_m), key=lambda z: abs(z - 2 * near_m))
    fb, k, middle_m = subject.focal_baseline, subject.sensor.intrinsics, (near_m + far_m) / 2
    shadow = (fb or 0.0) * (1 / near_m - 1 / far_m)
    around = int(np.ceil(abs(shadow))) + subject.margin_px + 20  # a projector may be to the left
    found: dict[str, list[np.ndarray]] = defaultdict(list)
    for i in range(frames):
        place = ((i + 0.5) / frames + 0.13, (0.37 * i) % 1)
        front = _facing(near_m, k.focal_px, _HALF_PX, place)
        wall, around_wall = (
            _facing(far_m, k.focal_px, _HALF_PX + n * around, place) for n in (3, 1)
        )
        rng = np.random.default_rng([0, i])
        frame = subject.sensor.scan(
            (quad(front), quad(wall)), box_of(around_wall), POSE, renderer, rng, explain=True
        )
        assert frame is not None, "the square is outside the view"
        clean, depth = frame.clean_m, frame.depth_m
        disparity = frame.images.get("disparity")
        if frame.step_px > 1 and disparity is not None and fb is not None:
            clean = frame.images["clean"]
            with np.errstate(divide="ignore", invalid="ignore"):
                depth = (fb / disparity).astype(np.float32)
        for key, image in (("camera", "seen"), ("projector", "lit")):
            if image in frame.images:
                found[key].append(_shadow(clean, ~frame.images[image], middle_m))
        found["edge"].append(_open_edge(clean, depth, middle_m))
    out: dict[str, Any] = {"sensor": subject.name, "near_m": near_m, "far_m": far_m}
    for key in ("camera", "projector"):
        if key in found:
            left, right = np.concatenate(found[key]).mean(axis=0)
            out |= {f"{key}_left_px": float(left), f"{key}_right_px": float(right)}
    if "camera" in found:
        out["camera_expected_px"] = shadow
    # Of two cameras the projector is in the middle, one has it at the end of the baseline.
    source_m = getattr(subject.sensor, "lamp_offset_m", None)
    if subject.baseline_m is not None:
        source_m = subject.baseline_m / (2 if "camera" in found else 1)
    if source_m is not None:
        out["projector_expected_px"] = k.focal_px * source_m * (1 / near_m - 1 / far_m)
    edges = np.concatenate(found["edge"])
    out["reaches_px"], out["wall_px"] = (median(column) for column in edges.T)
    out["half_window_px"] = np.nan if subject.window_px is None else subject.window_px / 2
    return out


def _facing(
    depth_m: float, focal_px: float, half_px: float, centre_px: tuple[float, float]
) -> np.ndarray:
    """[4, 3] corners of a square that faces the camera, with its size and place in pixels."""
    (u, v), px = centre_px, depth_m / focal_px
    x = np.array([u - half_px, u + half_px, u + half_px, u - half_px]) * px
    y = np.array([v - half_px, v - half_px, v + half_px, v + half_px]) * px
    return np.stack([x, y, np.full(4, depth_m)], axis=1)


def _inner_rows(square: np.ndarray) -> np.ndarray:
    """Rows of the inner half of a square, of [h, w] bool."""
    rows = np.flatnonzero(square.any(axis=1))
    return rows[len(rows) // 4 : -len(rows) // 4]


def _shadow(clean: np.ndarray, dark: np.ndarray, middle_m: float) -> np.ndarray:
    """[rows, 2] dark pixels of the wall, left and right of the square."""
    square = clean < middle_m
    out = []
    for row in _inner_rows(square):
        first, *_, last = np.flatnonzero(square[row])
        out.append([dark[row, :first].sum(), dark[row, last + 1 :].sum()])
    return np.array(out, dtype=np.float64).reshape(-1, 2)


def _open_edge(clean: np.ndarray, depth: np.ndarray, middle_m: float) -> np.ndarray:
    """[rows, 2] at the right side of the square, NaN where there are none.

    px by which near depths reach beyond it; px to the first five in a row of the wall's depth.
    """
    square = clean < middle_m
    with np.errstate(invalid="ignore"):
        near, far = depth < middle_m, depth >= middle_m
    out = []
    for row in _inner_rows(square):
        edge = int(np.flatnonzero(square[row])[-1])
        last = np.nan
        for column in range(max(edge - 20, 0), min(edge + 40, len(near[row]))):
            if near[row, column]:
                last = column
            elif column - last > 3:
                break
        beyond = np.convolve(far[row, edge + 1 :], _IN_A_ROW, mode="valid") == len(_IN_A_ROW)
        out.append([last - edge, np.argmax(beyond) if beyond.any() else np.nan])
    return np.array(out, dtype=np.float64)
