"""What scans leave besides their clouds: each point's provenance, views, and contact sheets.

    views/chair/train/chair_0007/view_0.npz    see `save_view`
    views/chair/train/chair_0007/view_0.png    infrared, disparity, depth, and why there is none

The worker that scans an object writes its views, each atomically, before the object counts as done:
an interruption loses nothing, because an object that is not done is scanned again and gives the
same bytes.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from qs3.errors import DataError, Qs3Error
from qs3.geometry.cameras import Camera, Intrinsics
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
_LONGEST_NAME = 200  # bytes; file systems allow 255, and the temporary name is longer
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
_IMAGES = {"infrared": ("infrared", "gray", ""), "disparity": ("disparity", "viridis", "px"),
           "depth_m": ("depth", "viridis", "m")}  # fmt: skip

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Keep:
    """What is wanted besides the cloud. None of it changes a byte of the cloud.

    Attributes:
        provenance: add the array "provenance" to the cloud.
        views: folder for the images and depths of every view; None keeps none. The views are
            then scanned with `explain`, which costs renders.
        previews: ids of the objects whose first view is kept in small, for the contact sheet.
    """

    provenance: bool = False
    views: Path | None = None
    previews: frozenset[str] = frozenset()


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


def preview_of(frame: DepthFrame) -> dict[str, np.ndarray]:
    """The pictures of a view that the contact sheet shows, by name: [h, w] each."""
    disparity = frame.images.get("disparity")
    if disparity is not None:  # as coarse as the depth: a preview is small
        disparity = disparity[:: frame.step_px, :: frame.step_px]
    found = {
        "infrared": photograph(frame.images),
        "disparity": disparity,
        "depth_m": frame.depth_m,
    }
    return {name: np.array(image) for name, image in found.items() if image is not None}


class DiskError(Qs3Error):
    """A file of the dataset cannot be written; not the fault of the object."""


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
    try:
        save_png(view_picture(frame), folder / f"view_{view}.png")
        write_bytes(folder / f"view_{view}.npz", compressed.getvalue())
    except (OSError, Qs3Error) as error:
        raise DiskError(str(error)) from error


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
    """The views of an object that `save_view` wrote, by number; none if there are none."""
    found = []
    for path in view_folder(root, object_id).glob("view_*.npz"):
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = dict(file)
            found.append(_kept(int(path.stem.removeprefix("view_")), arrays))
        except Exception as error:  # arrays of any kind may be where others were
            raise DataError(f"{path} is damaged: {error}") from error
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


def _range(values: np.ndarray) -> tuple[float, float]:
    """From where to where a picture's values are drawn: the middle 96 % of the finite ones."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [2, 98]) if len(finite) else (0.0, 0.0)
    return float(low), float(high)


def view_images(frame: DepthFrame) -> list[tuple[str, Image]]:
    """Infrared image, disparity, depth and reasons of a view, with their titles."""
    found = []
    for name, values, colours, unit in (
        ("infrared", photograph(frame.images), "gray", ""),
        ("disparity", frame.images.get("disparity"), "viridis", "px"),
        ("depth", frame.depth_m, "viridis", "m"),
    ):
        if values is not None:
            low, high = _range(values)
            title = f"{name}, {low:.2f} to {high:.2f} {unit}"
            found.append((title, value_image(values, low, high, colours)))
    reasons = np.zeros((*frame.reason.shape, 3), dtype=np.uint8)
    shares = []
    for reason, bgr in REASON_COLOURS.items():
        reasons[frame.reason == reason] = bgr[::-1]
        if share := float((frame.reason == reason).mean()):
            shares.append(f"{reason.name.lower()} {share:.1%}")
    return [*found, ("why there is a depth or none:\n" + "\n".join(shares), reasons)]


def view_picture(frame: DepthFrame) -> Figure:
    """The images of a view side by side."""
    titles, images = zip(*view_images(frame), strict=True)
    return sheet(images, titles, columns=len(titles), panel_in=_PANEL_IN)


def _safe(part: str) -> str:
    """A name for a folder: letters, digits and -._~ stay, the rest becomes %XX."""
    name = quote(part, safe="")
    if name in ("", ".", ".."):
        return f"%{part.encode().hex()}"
    if len(name) > _LONGEST_NAME:
        digest = hashlib.sha256(part.encode()).hexdigest()[:16]
        return f"{name[:_LONGEST_NAME]}%{digest}"
    return name


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


def infrared_picture(path: Path, previews: Mapping[str, tuple[str, Arrays]], heading: str) -> None:
    """Save one view a class: what the camera saw, the disparity, the depth.

    Args:
        path: of the PNG.
        previews: by class, an object's id and its pictures (qs3.generation.kept.preview_of).
        heading: a line above all.
    """
    images, titles = [], []
    for cls, (_, pictures) in previews.items():
        for kind, (name, colours, unit) in _IMAGES.items():
            values = np.asarray(pictures.get(kind, np.full((3, 4), np.nan)), dtype=np.float64)
            low, high = _range(values)
            images.append(value_image(values, low if unit else 0.0, high, colours))
            words = f" {low:.2f} to {high:.2f} {unit}" if unit and high > low else ""
            titles.append(f"{cls}: {name}{words}")
    save_png(sheet(images, titles, columns=6, heading=heading, panel_in=1.7), path, colours=256)
