"""What scans leave besides their clouds: each point's provenance, views, and a contact sheet.

    views/chair/train/chair_0007/view_0.npz    see `save_view`
    views/chair/train/chair_0007/view_0.png    infrared, disparity, depth, and why there is none

The worker that scans an object writes its views, each atomically, before the object counts as done:
an interruption loses nothing, because an object that is not done is scanned again and gives the
same bytes.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from qs3.errors import Qs3Error
from qs3.sensors.base import DepthFrame
from qs3.sensors.optics.visibility import Reason
from qs3.utils.files import remove_leftovers, write_bytes
from qs3.utils.pictures import Image, cloud_image, save_png, sheet, value_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PROVENANCE = ("view", "u_px", "v_px", "residual_m", "incidence_deg")
"""Columns of the array "provenance": see `provenance_of`."""

NO_RESIDUAL_M = -99.0
NO_INCIDENCE_DEG = -1.0

_NOT_A_PHOTOGRAPH = ("right", "reference", "disparity", "clean", "lit", "seen")
_MAPS = ("depth_m", "clean_m", "label", "cosine", "reason")  # of a DepthFrame
_PANEL_IN = 2.5  # of a picture
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
OBJECTS = 4  # a class, in clouds.png
_KINDS = {"points": "measured", "points_clean": "clean twin"}
Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Keep:
    """What is wanted besides the cloud. None of it changes a byte of the cloud.

    Attributes:
        provenance: add the array "provenance" to the cloud.
        view: takes each view as `save_view` does, from its object's id on; None drops them. With
            it views are scanned with `explain`, which costs renders.
    """

    provenance: bool = False
    view: Callable[[str, int, DepthFrame, np.ndarray, np.ndarray], None] | None = None


def provenance_of(frame: DepthFrame, depth_m: np.ndarray, view: int) -> np.ndarray:
    """Where each point of `frame.points(depth_m, ...)` comes from, in the same order.

    Args:
        frame: the view.
        depth_m: [h, w] its depth, maybe masked; pixels that are not finite are left out.
        view: its number among the object's views, from 0.

    Returns:
        [M, 5] float32, columns as in `PROVENANCE`: number of the view; pixel (u, v) of the
        sensor's camera; measured minus true depth; angle between the surface's normal and the
        ray, 0 to 90. Where no surface lies behind the pixel (the matcher's patch reached over
        an edge) the last two have no value and are -99 and -1.
    """
    rows, cols = np.nonzero(np.isfinite(depth_m))
    clean = frame.clean_m[rows, cols].astype(np.float64)
    hit = np.isfinite(clean)
    error = depth_m[rows, cols] - np.where(hit, clean, 0)
    cosine = np.clip(frame.cosine[rows, cols].astype(np.float64), 0, 1)
    columns = (
        np.full(len(rows), view),
        frame.left + cols * frame.step_px,
        frame.top + rows * frame.step_px,
        np.where(hit, error, NO_RESIDUAL_M),
        np.where(hit, np.rad2deg(np.arccos(cosine)), NO_INCIDENCE_DEG),
    )
    return np.stack(columns, axis=1).astype(np.float32)


def photograph(images: dict[str, np.ndarray]) -> np.ndarray | None:
    """[h, w] what the sensor's (left) camera saw, as grey values; None if it shows nothing."""
    for name, image in images.items():
        if name in _NOT_A_PHOTOGRAPH:
            continue
        flat = image[0] if image.ndim == 3 else image  # of a sequence, the first
        if flat.ndim == 2 and flat.dtype != bool:
            return flat
    return None


class DiskError(Qs3Error):
    """A file of the dataset cannot be written; not the fault of the object."""


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
    """
    folder = root / object_id
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
    try:
        save_png(view_picture(frame), folder / f"view_{view}.png")
        write_bytes(folder / f"view_{view}.npz", compressed.getvalue())
    except (OSError, Qs3Error) as error:
        raise DiskError(str(error)) from error


def _range(values: np.ndarray) -> tuple[float, float]:
    """From where to where a picture's values are drawn: the middle 96 % of the finite ones."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [2, 98]) if len(finite) else (0.0, 0.0)
    return float(low), float(high)


def view_images(frame: DepthFrame) -> list[tuple[str, Image]]:
    """Infrared images, disparity, depth and reasons of a view, with their titles."""
    found = []
    for name, values, colours, unit in (
        ("infrared", photograph(frame.images), "gray", ""),
        ("infrared, right", frame.images.get("right"), "gray", ""),
        ("disparity", frame.images.get("disparity"), "viridis", "px"),
        ("depth", frame.depth_m, "viridis", "m"),
    ):
        if values is not None:
            low, high = _range(values)
            title = f"{name}, {low:.2f} to {high:.2f} {unit}"
            found.append((title, value_image(values, low, high, colours)))
    title, image = reason_image(frame.reason)
    return [*found, (f"why there is a depth or none:\n{title}", image)]


def reason_image(reason: np.ndarray) -> tuple[str, Image]:
    """The shares of the reasons [h, w] in words, and the reasons in colours."""
    image = np.zeros((*reason.shape, 3), dtype=np.uint8)
    shares = []
    for one, bgr in REASON_COLOURS.items():
        image[reason == one] = bgr[::-1]
        if (share := float((reason == one).mean())) >= 0.0005:
            shares.append(f"{one.name.lower()} {share:.1%}")
    return "\n".join(shares), image


def view_picture(frame: DepthFrame) -> Figure:
    """The images of a view side by side."""
    titles, images = zip(*view_images(frame), strict=True)
    return sheet(images, titles, columns=len(titles), panel_in=_PANEL_IN)


def clouds_picture(path: Path, clouds: Mapping[str, Sequence[Arrays]], heading: str) -> None:
    """Save a row of clouds a class, each as measured and next to it from the true depth.

    Args:
        path: of the PNG.
        clouds: by class, some objects' arrays "points" and maybe "points_clean": [P, 3].
        heading: a line above all.
    """
    twin = any("points_clean" in arrays for some in clouds.values() for arrays in some)
    kinds = list(_KINDS)[: 1 + twin]
    shown = [some[i][kind] if i < len(some) else None
             for some in clouds.values() for i in range(OBJECTS) for kind in kinds]  # fmt: skip
    figure = sheet(
        [None if cloud is None else cloud_image(cloud, 320) for cloud in shown],
        ["" if cloud is None else f"{np.ptp(cloud, axis=0).max():.2g} m" for cloud in shown],
        columns=OBJECTS * len(kinds),
        heading=heading,
        rows=list(clouds),
        heads=[_KINDS[kind] for kind in kinds] * OBJECTS,
        panel_in=1.25,
    )
    save_png(figure, path, colours=256)
