"""Depth frames in files, and the camera that took them."""

from __future__ import annotations

import json
import logging
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.datasets.clouds.arrays import read_npy
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.geometry.cameras import Intrinsics
from qs3.utils.memory import JSON_PEAK, read_whole
from qs3.utils.pictures import png_bytes, read_png
from qs3.utils.yamls import load_yaml

log = logging.getLogger(__name__)

_MAX_PIXELS = 1 << 26
_RESOLUTIONS_M = (0.01, 0.001, 0.0001)
_FAR_M = 100.0  # no wall that somebody measures
_INVALID = 65535  # of 16 bits; 0 is the usual mark
_FIELD_DEG = (2.0, 170.0)  # of view: less or more, and the focal length is not in pixels
_BENT = ("D", "d", "coeffs", "distortion_coefficients")
_DOCUMENT = re.compile(r"^---\s*$", re.MULTILINE)
_OFF = 0.2  # of a side, from the middle of a picture that is none of a crop


@dataclass(frozen=True, eq=False)
class DepthImage:
    """One depth frame.

    Attributes:
        name: of its file, for messages.
        depth_m: [h, w] float64 metres, NaN where nothing was measured.
        resolution_m: all depths are whole multiples of it; 0 if there is no such step.
        unit: what the file's numbers were taken for, and why.
    """

    name: str
    depth_m: np.ndarray
    resolution_m: float
    unit: str


def read_camera(text: str, width_px: int, height_px: int) -> Intrinsics:
    """`fx,fy,cx,cy`, or a JSON or YAML file with fx, fy, cx, cy.

    Or with ppx and ppy, as librealsense calls them, or a matrix: ROS's K, k or camera_matrix,
    Open3D's intrinsic_matrix.

    Raises:
        ConfigError: it is neither, pixels are not square, the principal point lies outside of the
            picture, or the file has the width and height of pictures of another size.
        MissingDataError: there is no such file.
        DataError: the file does not hold them.
    """
    if text.lower().endswith((".json", ".yaml", ".yml")):
        found = _mapping(text)
        values = _four(found)
        if values is None:
            raise DataError(
                f"intrinsics={text} has neither fx, fy, cx, cy nor a matrix K or intrinsic_matrix"
            )
        _check_size(found, width_px, height_px, text)
        bent = next((found[key] for key in _BENT if key in found), None)
        if isinstance(bent, list) and any(one != 0 for one in bent):
            log.warning("intrinsics=%s: the lens's distortion is known and not corrected", text)
    else:
        try:
            values = [float(word) for word in text.split(",")]
        except ValueError:
            values = []
        if len(values) != 4:
            raise ConfigError(
                f"intrinsics={text!r}: write fx,fy,cx,cy in pixels, or a .json or .yaml file"
            )
    fx, fy, cx, cy = values
    if not (fx > 0 and fy > 0 and np.isfinite(values).all()):
        raise ConfigError(
            f"intrinsics=: fx and fy must be positive, cx and cy finite, got {values}"
        )
    if not 0.95 < fx / fy < 1.05:
        raise ConfigError(f"intrinsics=: fx {fx} and fy {fy} differ; pixels must be square")
    # At twice the size the middle is the corner of these.
    if not (-0.5 < cx < width_px - 0.5 and -0.5 < cy < height_px - 0.5):
        raise ConfigError(
            f"intrinsics=: the principal point ({cx:g}, {cy:g}) is outside of the frames of "
            f"{width_px} x {height_px} px; are these of another resolution?"
        )
    return Intrinsics(width_px, height_px, (fx + fy) / 2, cx, cy)


def check_field(camera: Intrinsics) -> None:
    """Raise ConfigError if no depth camera sees so little or so much."""
    side = max(camera.width_px, camera.height_px)
    field = math.degrees(2 * math.atan(side / 2 / camera.focal_px))
    if not _FIELD_DEG[0] <= field <= _FIELD_DEG[1]:
        raise ConfigError(
            f"a focal length of {camera.focal_px:g} px with {side} px makes a field of view of "
            f"{field:.1f}°; give it in pixels"
        )


def off_centre(camera: Intrinsics) -> str:
    """That the principal point lies far from the middle, in words; "" where it does not."""
    x = abs(camera.cx_px - (camera.width_px - 1) / 2) / camera.width_px
    y = abs(camera.cy_px - (camera.height_px - 1) / 2) / camera.height_px
    if max(x, y) <= _OFF:
        return ""
    return (
        f"the principal point ({camera.cx_px:g}, {camera.cy_px:g}) lies {max(x, y):.0%} of a side "
        f"from the middle of the frames of {camera.width_px} x {camera.height_px} px: unless they "
        "are a crop, the intrinsics are those of another resolution"
    )


def _check_size(found: dict[str, object], width_px: int, height_px: int, text: str) -> None:
    for keys in (("width", "height"), ("image_width", "image_height")):
        size = [found.get(key) for key in keys]
        if None not in size and size != [width_px, height_px]:
            raise ConfigError(
                f"intrinsics={text} is of pictures of {size[0]} x {size[1]} px, these frames have "
                f"{width_px} x {height_px}"
            )


def _mapping(text: str) -> dict[str, object]:
    """What a file holds, and what stands in it under `intrinsics` or about a matrix; or nothing."""
    try:
        data = read_whole(Path(text), JSON_PEAK)
        if text.lower().endswith(".json"):
            found = json.loads(data)
        else:  # `rostopic echo` ends a message as YAML does a document
            plain = data.decode().removeprefix("%YAML:1.0").replace("!!opencv-matrix", "")
            documents = _DOCUMENT.split(plain)
            found = load_yaml(next(filter(str.strip, documents), ""), f"intrinsics={text}")
    except OSError as error:
        raise MissingDataError(f"intrinsics={text}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        kind = "JSON" if text.lower().endswith(".json") else "YAML"
        raise DataError(f"intrinsics={text} is not {kind}: {error}") from error
    if not isinstance(found, dict):
        return {}
    inner = found.get("intrinsics")
    found = {**found, **inner} if isinstance(inner, dict) else found
    data_of = {key: one["data"] for key, one in found.items() if _is_matrix(one)}
    return {**found, **data_of}


def _is_matrix(found: object) -> bool:
    """Whether it is one in ROS's and OpenCV's words: rows, cols and data."""
    return isinstance(found, dict) and "data" in found


def _four(found: dict[str, object]) -> list[float] | None:
    values: Any = found
    try:
        for keys in (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy")):  # librealsense
            if all(key in values for key in keys):
                return [float(values[key]) for key in keys]
        for key in ("K", "k", "intrinsic_matrix", "camera_matrix"):
            if key in values:
                k = np.asarray(values[key], dtype=np.float64).reshape(-1)
                if len(k) != 9:
                    return None
                # Row by row has 0 0 1 at its end; column by column has cx there (Open3D).
                if k[6] == 0 and k[7] == 0:
                    return [k[0], k[4], k[2], k[5]]
                return [k[0], k[4], k[6], k[7]]
    except (TypeError, ValueError, OverflowError):
        return None
    return None


def read_frame(path: str | Path, unit: str | None = None) -> DepthImage:
    """One depth frame: 16 bit PNG, .npy, or an organised .pcd cloud.

    `unit` is "m", "mm", units a metre as a number, or None: as the numbers look.

    Raises:
        MissingDataError: there is no such file.
        DataError: it is not a depth image, or its unit cannot be told.
    """
    path = Path(path)
    if path.is_dir():
        raise MissingDataError(f"{path} is a folder: name its frames, {path}/*.png")
    if not path.is_file():
        raise MissingDataError(f"{path}: there is no such file")
    suffix = path.suffix.lower()
    if suffix == ".png":
        raw = _png(path)
    elif suffix == ".npy":
        raw = _npy(path)
    elif suffix == ".pcd":
        from qs3.datasets.clouds.pcd import read_pcd

        cloud = read_pcd(path)
        try:
            raw = cloud.image("z")
        except DataError as error:
            raise DataError(f"{path}: {error}; an organised cloud is needed") from error
    else:
        raise DataError(f"{path}: depth frames are read from .png, .npy and .pcd")
    if raw.ndim != 2 or raw.dtype.kind not in "iuf":
        raise DataError(f"{path} is not a depth image: {raw.dtype} of shape {list(raw.shape)}")
    return as_frame(path.name, raw, unit)


def as_frame(name: str, raw: np.ndarray, unit: str | None = None) -> DepthImage:
    """An array as a depth frame; see `read_frame`."""
    values = raw.astype(np.float64)
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(values) & (values > 0)
    if raw.dtype == np.uint16:
        valid &= raw != _INVALID
    if not valid.any():
        raise DataError(f"{name} has no pixel with a depth")
    whole = raw.dtype.kind in "iu"
    middle = float(np.median(values[valid]))
    scale, words = _scale(name, middle, whole, unit)
    if middle / scale > _FAR_M:
        raise DataError(
            f"{name}: with unit={unit} half of its depths are beyond {middle / scale:.4g} m: are "
            "they in another unit?"
        )
    depth = np.where(valid, values / scale, np.nan)
    resolution = 1 / scale if whole else _resolution(depth[valid])
    return DepthImage(name, depth, resolution, words)


def _scale(name: str, middle: float, whole: bool, unit: str | None) -> tuple[float, str]:
    """Units a metre, and how that was found."""
    if unit == "m":
        return 1.0, "metres, as given"
    if unit == "mm":
        return 1000.0, "millimetres, as given"
    if unit is not None:
        try:
            scale = float(unit)
        except ValueError:
            scale = 0.0
        if not (scale > 0 and np.isfinite(scale)):
            raise ConfigError(f"unit={unit}: write m, mm or a number of units a metre")
        return scale, f"{scale:g} units a metre, as given"
    if not whole and middle < 20:
        return 1.0, f"metres, because the median is {middle:.3g}"
    if 200 <= middle <= 12_000:
        return 1000.0, f"millimetres, because the median is {middle:.4g}"
    raise DataError(
        f"{name}: a median depth of {middle:.4g} may be metres, millimetres or something else; "
        "say it: unit=m, unit=mm, or unit=N for N units a metre (5000 in TUM's images)"
    )


def _resolution(depth_m: np.ndarray) -> float:
    """The coarsest of some usual steps that all depths are multiples of; 0 if there is none."""
    some = depth_m[:: max(1, len(depth_m) // 50_000)]
    for step in _RESOLUTIONS_M:
        phase = some / step
        off = np.abs(phase - np.rint(phase))
        if (off < 0.002 + 3e-7 * phase).mean() > 0.999 and len(np.unique(np.rint(phase))) > 1:
            return step
    return 0.0


def _png(path: Path) -> np.ndarray:
    image = read_png(png_bytes(path), str(path))
    if image.dtype != np.uint16:
        raise DataError(f"{path} is not a depth image: 8 bits a pixel; 16 bit grey is needed")
    return image


def _npy(path: Path) -> np.ndarray:
    def check(shape: tuple[int, ...], dtype: np.dtype) -> None:
        if (size := math.prod(shape)) > _MAX_PIXELS:
            raise DataError(f"{path} has {size} values; at most {_MAX_PIXELS} are read")

    return read_npy(path, check)
