"""The views of an object on disk: all that was seen and measured, and a picture of it.

    views/chair/train/chair_0007/view_0.npz    see `save_view`
    views/chair/train/chair_0007/view_0.png    infrared, disparity, depth, and why there is none

The worker that scans an object writes them, each atomically, before the object counts as done:
an interruption loses nothing, because an object that is not done is scanned again and gives the
same bytes.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np

from qs3.errors import DataError, Qs3Error
from qs3.generation.provenance import photograph
from qs3.geometry.cameras import Camera, Intrinsics
from qs3.sensors.base import DepthFrame
from qs3.sensors.optics.visibility import Reason
from qs3.utils.files import remove_leftovers, write_bytes

_MAPS = ("depth_m", "clean_m", "label", "cosine", "reason")  # of a DepthFrame
_LONGEST_NAME = 200  # bytes; file systems allow 255, and the temporary name is longer
_DARK = (24, 20, 18)  # BGR, where nothing was measured
_LEAST_PX = 300  # height of a panel
REASON_COLOURS = {  # BGR
    Reason.OK: (120, 160, 60),
    Reason.EMPTY: (24, 20, 18),
    Reason.SHADOW: (120, 90, 90),
    Reason.OCCLUDED: (190, 120, 70),
    Reason.OUTSIDE: (140, 140, 140),
    Reason.DARK: (60, 60, 140),
    Reason.SATURATED: (240, 240, 240),
    Reason.AMBIGUOUS: (60, 190, 240),
    Reason.INCONSISTENT: (200, 90, 190),
    Reason.RANGE: (200, 200, 80),
    Reason.FILTERED: (50, 120, 240),
    Reason.UNMATCHED: (60, 40, 220),
}


class DiskError(Qs3Error):
    """A file of the dataset cannot be written; not the fault of the object."""


@contextlib.contextmanager
def disk_errors_travel() -> Iterator[None]:
    """Turn what a full disk raises into a DiskError that reaches the parent process whole.

    Raises:
        DiskError: with the system's `errno`.
    """
    try:
        yield
    except (OSError, Qs3Error) as error:
        if isinstance(error, DiskError):
            raise
        problem = DiskError(str(error))
        # Kept as a plain value: on its way out of a worker an error loses its cause.
        source = error if isinstance(error, OSError) else error.__cause__
        problem.errno = getattr(source, "errno", None)  # type: ignore[attr-defined]
        raise problem from error


def view_folder(root: Path, object_id: str) -> Path:
    """Where an object's views lie below `root`; different ids never share a folder."""
    return root.joinpath(*(_safe(part) for part in object_id.split("/")))


def save_view(
    root: Path,
    object_id: str,
    view: int,
    frame: DepthFrame,
    world_from_camera: np.ndarray,
    believed: np.ndarray,
) -> None:
    """Write view_<n>.npz and view_<n>.png of one view; the same view gives the same bytes.

    The arrays of the .npz (numpy.load reads it):
        depth_m, clean_m, label, cosine, reason: [h, w], see DepthFrame; `reason_names` holds
            the names of the numbers in `reason`.
        image_left, image_right, image_disparity, ...: what the sensor shows, [H, W].
        size_px, focal_px, centre_px: of the camera: (width, height), focal length, (cx, cy).
        grid_px: (left, top, step): sample (r, c) is pixel (left + c step, top + r step).
        world_from_camera, world_from_camera_believed: [4, 4] the true pose, and the one that
            tracking believes.

    Raises:
        DiskError: they cannot be written.
    """
    folder = view_folder(root, object_id)
    remove_leftovers(folder)
    k = frame.camera.intrinsics
    arrays: dict[str, np.ndarray] = {
        **{name: getattr(frame, name) for name in _MAPS},
        "reason_names": np.array([reason.name for reason in Reason]),
        **{f"image_{name}": image for name, image in frame.images.items()},
        "size_px": np.array([k.width_px, k.height_px]),
        "focal_px": np.array(k.focal_px),
        "centre_px": np.array([k.cx_px, k.cy_px]),
        "grid_px": np.array([frame.left, frame.top, frame.step_px]),
        "world_from_camera": world_from_camera,
        "world_from_camera_believed": believed,
    }
    # In memory first: a zip file that a full disk breaks off complains once more at its end.
    compressed = io.BytesIO()
    np.savez_compressed(compressed, **arrays)
    encoded = cv2.imencode(".png", view_picture(frame))[1]
    with disk_errors_travel():
        write_bytes(folder / f"view_{view}.png", encoded.tobytes())
        write_bytes(folder / f"view_{view}.npz", compressed.getvalue())


@dataclass(frozen=True, eq=False)
class KeptView:
    """A view as `save_view` was given it.

    Attributes:
        number: among the object's views, from 0.
        frame: what was measured.
        world_from_camera: [4, 4] the true pose.
        believed: [4, 4] the pose that tracking believes.
    """

    number: int
    frame: DepthFrame
    world_from_camera: np.ndarray
    believed: np.ndarray


def load_views(root: Path, object_id: str) -> tuple[KeptView, ...]:
    """The views of an object that `save_view` wrote, by number; none if there are none.

    Raises:
        DataError: a file is damaged.
    """
    found = []
    for path in view_folder(root, object_id).glob("view_*.npz"):
        try:
            with np.load(path, allow_pickle=False) as arrays:
                found.append(_kept(int(path.stem.removeprefix("view_")), dict(arrays)))
        except Exception as error:  # arrays of any kind may be where others were
            raise DataError(f"{path} is damaged ({error}); generate the dataset again") from error
    return tuple(sorted(found, key=lambda view: view.number))


def _kept(number: int, arrays: dict[str, Any]) -> KeptView:
    width, height = (int(value) for value in arrays["size_px"])
    cx, cy = (float(value) for value in arrays["centre_px"])
    left, top, step = (int(value) for value in arrays["grid_px"])
    intrinsics = Intrinsics(width, height, float(arrays["focal_px"]), cx, cy)
    images = {name[6:]: image for name, image in arrays.items() if name.startswith("image_")}
    pose, believed = arrays["world_from_camera"], arrays["world_from_camera_believed"]
    maps = {name: arrays[name] for name in _MAPS}
    frame = DepthFrame(Camera(intrinsics, pose), left, top, step, images=images, **maps)
    return KeptView(number, frame, pose, believed)


def view_picture(frame: DepthFrame) -> np.ndarray:
    """[H, W, 3] uint8 BGR: infrared image, disparity, depth and reasons side by side."""
    seen = photograph(frame.images)
    height = max(_LEAST_PX, 0 if seen is None else seen.shape[0], frame.depth_m.shape[0])
    panels = []
    if seen is not None:
        panels.append(_panel(_grey(seen), "infrared", height))
    if (disparity := frame.images.get("disparity")) is not None:
        panels.append(_panel(_coloured(disparity), _range("disparity", disparity, "px"), height))
    panels.append(_panel(_coloured(frame.depth_m), _range("depth", frame.depth_m, "m"), height))
    reasons = np.zeros((*frame.reason.shape, 3), dtype=np.uint8)
    for reason, colour in REASON_COLOURS.items():
        reasons[frame.reason == reason] = colour
    panels.append(_panel(reasons, "why there is a depth or none", height))
    panels.append(_legend(frame.reason, panels[0].shape[0]))
    return np.concatenate(panels, axis=1)


def _grey(image: np.ndarray) -> np.ndarray:
    if image.dtype != np.uint8:
        finite = np.where(np.isfinite(image), image, 0).astype(np.float64)
        image = (finite / max(float(finite.max()), 1e-12) * 255).clip(0, 255).astype(np.uint8)
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)


def _coloured(values: np.ndarray) -> np.ndarray:
    """Near (or a large disparity) and far in colours, between the 2nd and 98th percentile."""
    finite = np.isfinite(values)
    out = np.full((*values.shape, 3), _DARK, dtype=np.uint8)
    if finite.any():
        low, high = np.percentile(values[finite], [2, 98])
        unit = (np.where(finite, values, low) - low) / max(float(high - low), 1e-12)
        colours = cv2.applyColorMap((unit.clip(0, 1) * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
        out[finite] = colours[finite]
    return out


def _range(what: str, values: np.ndarray, unit: str) -> str:
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return f"{what}: none"
    low, high = np.percentile(finite, [2, 98])
    return f"{what} {low:.2f} to {high:.2f} {unit}"


def _panel(image: np.ndarray, title: str, height: int) -> np.ndarray:
    """The image at a height, under a line of text, with a gap at its right."""
    width = max(1, round(image.shape[1] * height / image.shape[0]))
    scaled = cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST)
    out = np.full((height + 22, max(width, 9 * len(title)) + 6, 3), 255, dtype=np.uint8)
    out[22:, :width] = scaled
    _write(out, title, 2, 15)
    return out


def _legend(reason: np.ndarray, height: int) -> np.ndarray:
    out = np.full((max(height, 22 + 20 * len(Reason)), 190, 3), 255, dtype=np.uint8)[:height]
    y = 40
    for kind, colour in REASON_COLOURS.items():
        share = float((reason == kind).mean()) if reason.size else 0.0
        if share > 0:
            out[y - 10 : y + 2, 6:18] = colour
            _write(out, f"{kind.name.lower()} {share:.1%}", 26, y)
            y += 20
    return out


def _write(image: np.ndarray, text: str, x: int, y: int) -> None:
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 36, 30), 1, cv2.LINE_AA)


def _safe(part: str) -> str:
    """A name for a folder: letters, digits and -._~ stay, the rest becomes %XX."""
    name = quote(part, safe="")
    if name in ("", ".", ".."):
        return f"%{part.encode().hex()}"
    if len(name) > _LONGEST_NAME:
        digest = hashlib.sha256(part.encode()).hexdigest()[:16]
        return f"{name[:_LONGEST_NAME]}%{digest}"
    return name
