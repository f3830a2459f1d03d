"""Depth frames in files, and the camera that took them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.clouds.arrays import read_npy
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.geometry.cameras import Intrinsics
from qs3.utils.memory import JSON_PEAK, read_whole
from qs3.utils.pictures import png_bytes, read_png

_MAX_PIXELS = 1 << 26
_RESOLUTIONS_M = (0.01, 0.001, 0.0001)
_FAR_M = 100.0  # no wall that somebody measures
_INVALID = 65535  # of 16 bits; 0 is the usual mark


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
    """`fx,fy,cx,cy`, or a JSON file with fx, fy, cx, cy (also ppx, ppy, K or intrinsic_matrix).

    Raises:
        ConfigError: it is neither, pixels are not square, the principal point lies outside of the
            picture, or the file has the width and height of pictures of another size.
        MissingDataError: there is no such file.
        DataError: the file does not hold them.
    """
    if text.lower().endswith(".json"):
        try:
            found = json.loads(read_whole(Path(text), JSON_PEAK))
            values = _four(found)
        except OSError as error:
            raise MissingDataError(f"intrinsics={text}: {error.strerror or error}") from error
        except (ValueError, RecursionError) as error:
            raise DataError(f"intrinsics={text} is not JSON: {error}") from error
        if values is None:
            raise DataError(
                f"intrinsics={text} has neither fx, fy, cx, cy nor a matrix K or intrinsic_matrix"
            )
        _check_size(found, width_px, height_px, text)
    else:
        try:
            values = [float(word) for word in text.split(",")]
        except ValueError:
            values = []
        if len(values) != 4:
            raise ConfigError(f"intrinsics={text!r}: write fx,fy,cx,cy in pixels, or a .json file")
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


def _check_size(found: dict[str, object], width_px: int, height_px: int, text: str) -> None:
    for keys in (("width", "height"), ("image_width", "image_height")):
        size = [found.get(key) for key in keys]
        if None not in size and size != [width_px, height_px]:
            raise ConfigError(
                f"intrinsics={text} is of pictures of {size[0]} x {size[1]} px, these frames have "
                f"{width_px} x {height_px}"
            )


def _four(found: object) -> list[float] | None:
    if not isinstance(found, dict):
        return None
    try:
        for keys in (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy")):  # librealsense
            if all(key in found for key in keys):
                return [float(found[key]) for key in keys]
        for key in ("K", "intrinsic_matrix", "camera_matrix"):
            if key in found:
                k = np.asarray(found[key], dtype=np.float64).reshape(-1)
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
    if not path.is_file():
        raise MissingDataError(f"{path}: there is no such file")
    suffix = path.suffix.lower()
    if suffix == ".png":
        raw = _png(path)
    elif suffix == ".npy":
        raw = _npy(path)
    elif suffix == ".pcd":
        from qs3.clouds.pcd import read_pcd

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
