"""Depth images, masks and intrinsics in files as people have them; none is trusted.

    depth        .png   grey, 16 bits, a millimetre a unit (or `scale_m`); 0: not measured
                 .npy   [h, w] of floats in metres, or of whole numbers like those of a .png;
                        0, NaN or infinite: not measured
    mask         .png   grey or with a palette; .npy [h, w] of whole numbers or bool. 0 is no
                        object, every other number is one
    intrinsics   "fx,fy,cx,cy" in pixels, or a file .json, .yaml or .txt of
                 fx fy and cx cy (or ppx ppy, as librealsense calls them);
                 K, k, camera_matrix, intrinsic_matrix or cam_K: 9 numbers, by rows (ROS, OpenCV,
                 BOP) or by columns (Open3D); perhaps width and height, which must be the picture's;
                 or 4, 9 or 16 bare numbers (TUM, ScanNet); or these as an .npy.
                 Of several YAML documents (rostopic echo) the first counts

The centre of the top left pixel is (0, 0). Sizes are read and judged before a picture is unpacked.
"""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from qs3.datasets.clouds.arrays import read_npy
from qs3.datasets.frames.images import MAX_SIDE_PX, MOST_DEPTH_M, Pinhole
from qs3.errors import DataError, MissingDataError
from qs3.utils.pictures import png_header, read_png
from qs3.utils.plural import counted
from qs3.utils.yamls import load_yaml

MILLIMETRE = 1e-3
_MILLIMETRES = (1.0, MILLIMETRE, 1000.0)  # in BOP's, librealsense's and Open3D's words
MOST_OBJECTS = 1000
"""Limit on the objects of a mask: an image with more numbers is something else."""

_MOST_TEXT = 1 << 20  # bytes of a file with intrinsics
_MOST_PNG = 1 << 26
_PALETTE = 3
_MATRICES = ("K", "k", "camera_matrix", "intrinsic_matrix", "intrinsics", "intrinsic", "cam_K")
_DOCUMENT = re.compile(r"^---\s*$", re.MULTILINE)  # begins one, or ends the one before
_SIZES = (("width", "height"), ("image_width", "image_height"))
_CENTRES = (("cx", "cy"), ("ppx", "ppy"))
_BENT = ("D", "d", "coeffs", "distortion_coefficients")
_BENT_BY_ONE = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_UNMEASURED = 65535
"""What cameras that have no 0 write into 16 bits where nothing was measured."""

_SCALE = "depth_scale"
_OFF = 0.2  # of a side, from the picture's middle
_FIELD_DEG = (2.0, 170.0)  # of view: less or more, and the unit is wrong


class Intrinsics(NamedTuple):
    """A camera as a file describes it.

    Attributes:
        camera: without distortion.
        size: width and height in pixels, if the file has them.
        bent: the file has distortion coefficients, which are not used.
        depth_scale: what the file says under that name, in its own unit; see `read_depth`.
    """

    camera: Pinhole
    size: tuple[int, int] | None = None
    bent: bool = False
    depth_scale: float | None = None


def read_depth(
    path: str | Path, scale_m: float | None = None, of_camera: float | None = None
) -> Float[np.ndarray, "h w"]:
    """Depth in metres, float64; 0 where nothing was measured, which 16 bits say by 65535, too.

    Args:
        path: of a .png or .npy.
        scale_m: metres a unit; None: 0.001 for whole numbers, 1 for floats.
        of_camera: `depth_scale` of the file of intrinsics. Millimetres a unit (BOP), metres a unit
            (librealsense) and units a metre (Open3D) are called so, so that it is not used, but
            whole numbers of which it says that they are no millimetres are refused.

    Raises:
        MissingDataError: there is no such file.
        DataError: another format, damaged, too large, without any depth, or in another unit.
    """
    path = _there(path, "depth")
    if path.suffix.lower() == ".png":
        found = read_png(_content(path), str(path))
        if found.dtype != np.uint16:
            raise DataError(
                f"{path}: 8 bits a pixel are a picture of depths, not depths; expected 16 bits, "
                "in millimetres"
            )
    else:
        found = read_npy(path, lambda shape, dtype: _check_image(path, shape, dtype, "fiu"))
    whole = found.dtype.kind in "iu"
    if whole and scale_m is None and of_camera is not None and not _millimetres(of_camera):
        raise DataError(
            f"{path}: the intrinsics' file has depth_scale {of_camera:g}, so these are no "
            "millimetres; say what they are, depth_scale=METRES of a unit (a thousandth of BOP's)"
        )
    scale = scale_m if scale_m is not None else MILLIMETRE if whole else 1.0
    depth = found.astype(np.float64) * scale
    depth[~np.isfinite(depth) | (depth < 0)] = 0
    if found.dtype.kind == "u" and found.dtype.itemsize == 2:
        depth[found == _UNMEASURED] = 0
    if not (depth > 0).any():
        raise DataError(f"{path}: no pixel has depth")
    middle = float(np.median(depth[depth > 0]))
    if not 0.02 < middle < MOST_DEPTH_M:
        hint = "; are these millimetres? depth_scale=0.001" if not whole and scale == 1 else ""
        raise DataError(
            f"{path}: half of its depths are beyond {middle:.3g} m with {scale:g} m a unit; "
            f"depth_scale= gives the metres of a unit{hint}"
        )
    return depth


def _millimetres(depth_scale: float) -> bool:
    """Whether it means a millimetre a unit in anybody's words; librealsense's are float32."""
    return any(abs(depth_scale / one - 1) < 1e-3 for one in _MILLIMETRES)


def read_mask(path: str | Path) -> Int[np.ndarray, "h w"]:
    """Number of the object that each pixel shows, int64; 0 where it shows none.

    Raises:
        MissingDataError: there is no such file.
        DataError: another format, damaged, too large, empty, or no mask.
    """
    path = _there(path, "mask")
    if path.suffix.lower() == ".png":
        found = _mask_png(_content(path), str(path))
    else:
        found = read_npy(path, lambda shape, dtype: _check_image(path, shape, dtype, "iub"))
    return checked_mask(found, str(path))


def checked_mask(mask: np.ndarray, where: str) -> Int[np.ndarray, "h w"]:
    """A mask of whole numbers or bool as int64.

    Raises:
        DataError: of another kind or shape, empty, or with too many numbers; begins with `where`.
    """
    _check_image(where, mask.shape, mask.dtype, "iub")
    numbers: np.ndarray = mask.astype(np.int64)
    count = int((np.unique(numbers) != 0).sum())
    if count == 0:
        raise DataError(f"{where}: the mask marks no pixel")
    if count > MOST_OBJECTS:
        raise DataError(f"{where}: {count} different numbers are not a mask of objects")
    return numbers


def read_intrinsics(words: str, folder: Path | None = None) -> Intrinsics:
    """From "fx,fy,cx,cy" or a file.

    Args:
        words: numbers, or a path.
        folder: that a path is relative to.

    Raises:
        MissingDataError: there is no such file.
        DataError: it holds no intrinsics.
    """
    numbers = _numbers(words)
    if numbers is not None:
        return Intrinsics(camera_of(numbers, f"intrinsics={words}"))
    path = _there((folder or Path()) / Path(words).expanduser(), "intrinsics")
    if path.suffix.lower() == ".npy":
        matrix = read_npy(path, lambda shape, dtype: _check_matrix(path, shape, dtype))
        return Intrinsics(camera_of(matrix.ravel().tolist(), str(path)))
    data = _content(path, _MOST_TEXT)
    try:
        text = data.decode()
        found = _numbers(text)
        if found is not None:
            return Intrinsics(camera_of(found, str(path)))
        return _of_mapping(_parsed(text, str(path)), str(path))
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{path}: not a readable file of intrinsics ({error})") from error


def camera_of(values: Sequence[float], where: str) -> Pinhole:
    """From fx fy cx cy, or the 9 or 16 numbers of a matrix.

    Raises:
        DataError: other numbers; begins with `where`.
    """
    values = list(values)
    if len(values) == 16:
        values = [*values[:3], *values[4:7], *values[8:11]]
    if len(values) == 9:
        if values[2] == values[5] == 0:  # by columns
            values = [values[i] for i in (0, 3, 6, 1, 4, 7, 2, 5, 8)]
        fx, skew, cx, zero, fy, cy, *last = values
        if skew or zero or last != [0, 0, 1]:
            raise DataError(f"{where}: {values} is not a matrix fx 0 cx, 0 fy cy, 0 0 1")
        values = [fx, fy, cx, cy]
    if len(values) != 4:
        found = counted(len(values), "number")
        raise DataError(f"{where}: {found}; expected fx,fy,cx,cy or a 3 x 3 matrix")
    try:
        return Pinhole(*values)
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def check_intrinsics(given: Intrinsics, depth_m: Float[np.ndarray, "h w"], where: str) -> Pinhole:
    """The camera, if it can have taken a picture of this size.

    Raises:
        DataError: another size, a principal point outside of the picture, or focal lengths in
            another unit; begins with `where`.
    """
    height, width = depth_m.shape
    camera = given.camera
    if given.size is not None and given.size != (width, height):
        raise DataError(
            f"{where}: the intrinsics are of pictures of {given.size[0]} x {given.size[1]} px, "
            f"this one has {width} x {height}"
        )
    # Strictly: at twice the size the middle is the corner of this picture.
    if not (-0.5 < camera.cx_px < width - 0.5 and -0.5 < camera.cy_px < height - 0.5):
        raise DataError(
            f"{where}: the principal point ({camera.cx_px:g}, {camera.cy_px:g}) is outside of the "
            f"picture of {width} x {height} px; are the intrinsics those of another resolution, or "
            "is it a crop? Give the whole picture and a box"
        )
    for name, focal, side in (("fx", camera.fx_px, width), ("fy", camera.fy_px, height)):
        field = float(np.degrees(2 * np.arctan(side / 2 / focal)))
        if not _FIELD_DEG[0] <= field <= _FIELD_DEG[1]:
            raise DataError(
                f"{where}: {name} of {focal:g} px with {side} px makes a field of view of "
                f"{field:.1f}°; focal lengths are in pixels"
            )
    return camera


def off_centre(given: Intrinsics, depth_m: Float[np.ndarray, "h w"]) -> str:
    """Why the camera may be that of a picture of another size, in words; "" if nothing says so.

    Lenses sit before the middle of their sensors to a few per cent of its sides. Of a crop the
    centre may lie anywhere, so this is no error. A file that has the picture's size is believed.
    """
    height, width = depth_m.shape
    camera = given.camera
    off = abs(camera.cx_px - (width - 1) / 2) / width, abs(camera.cy_px - (height - 1) / 2) / height
    if given.size is not None or max(off) <= _OFF:
        return ""
    return (
        f"the principal point ({camera.cx_px:g}, {camera.cy_px:g}) lies {max(off):.0%} of a side "
        f"from the middle of the picture of {width} x {height} px: unless that is a crop, the "
        "intrinsics are those of another resolution"
    )


def check_metres(depth_m: Float[np.ndarray, "h w"], where: str) -> None:
    """Raise DataError, which begins with `where`, if these are no metres but millimetres."""
    measured = depth_m[np.isfinite(depth_m) & (depth_m > 0)]
    if measured.size and (middle := float(np.median(measured))) >= MOST_DEPTH_M:
        raise DataError(
            f"{where}: half of its depths are beyond {middle:.4g} m; if these are millimetres, "
            "divide them by 1000"
        )


def _there(path: str | Path, what: str) -> Path:
    path = Path(path).expanduser()
    if not path.is_file():
        raise MissingDataError(f"{what}={path} is not there")
    if what != "intrinsics" and path.suffix.lower() not in (".png", ".npy"):
        raise DataError(f"{path}: unknown format of a {what} image; known are .png and .npy")
    return path


def _content(path: Path, most: int = _MOST_PNG) -> bytes:
    """A file's bytes; DataError if it cannot be read or has more than `most`."""
    try:
        size = path.stat().st_size
        if size > most:
            raise DataError(f"{path}: {size} bytes, more than {most}; refused")
        with open(path, "rb") as file:
            return file.read(size)
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror or error})") from error


def _check_image(where: Any, shape: tuple[int, ...], dtype: np.dtype, kinds: str) -> None:
    if len(shape) != 2 or not 1 <= min(shape) <= max(shape) <= MAX_SIDE_PX:
        raise DataError(
            f"{where}: the array has shape {shape}, expected [height, width] of at most "
            f"{MAX_SIDE_PX} px a side"
        )
    if dtype.kind not in kinds:
        raise DataError(f"{where}: the array holds {dtype}, expected " + _KINDS[kinds])


def _check_matrix(where: Any, shape: tuple[int, ...], dtype: np.dtype) -> None:
    if shape not in ((4,), (3, 3), (4, 4)) or dtype.kind not in "fiu":
        raise DataError(
            f"{where}: the array is {dtype} {shape}; expected numbers fx fy cx cy, or a matrix "
            "of 3 x 3 or 4 x 4"
        )


_KINDS = {"fiu": "numbers", "iub": "whole numbers, one an object, or bool"}


def _mask_png(data: bytes, where: str) -> np.ndarray:
    """As `read_png`; of a picture with a palette the numbers of its colours."""
    *_, colour = png_header(data, where)
    if colour not in (0, _PALETTE):
        raise DataError(
            f"{where}: a picture in colours; a mask is grey or has a palette: 0 where no object "
            "is, and a number for each object"
        )
    if colour != _PALETTE and data[24] in (8, 16):
        return read_png(data, where)
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            return np.asarray(image)
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{where}: the PNG cannot be read ({error})") from error


def _numbers(text: str) -> list[float] | None:
    """What nothing but numbers are, between commas or blanks; else None."""
    try:
        return [float(word) for word in text.replace(",", " ").split()] or None
    except ValueError:
        return None


def _parsed(text: str, where: str) -> Any:
    """JSON or YAML, of which the first document counts; DataError if neither."""
    text = text.removeprefix("%YAML:1.0").replace("!!opencv-matrix", "")
    documents = (one for one in _DOCUMENT.split(text) if one.strip())
    return load_yaml(next(documents, ""), where)


def _of_mapping(given: Any, where: str) -> Intrinsics:
    if not isinstance(given, Mapping):
        raise DataError(f"{where}: no fx, fy, cx, cy and no matrix K")
    matrix = next((given[key] for key in _MATRICES if key in given), None)
    if isinstance(matrix, Mapping) and "data" not in matrix:
        beside = {
            *itertools.chain(*_SIZES),
            *_BENT,
            *_BENT_BY_ONE,
            _SCALE,
        }  # may stand within, or about it
        return _of_mapping({key: given[key] for key in beside & {*given}} | {**matrix}, where)
    if isinstance(matrix, Mapping):
        matrix = matrix["data"]
    if matrix is not None:
        values = _flat(matrix)
    else:
        centre = next((pair for pair in _CENTRES if pair[0] in given), ("cx", "cy"))
        if missing := [key for key in ("fx", "fy", *centre) if key not in given]:
            raise DataError(f"{where}: no {', '.join(missing)}, and no matrix K")
        values = [float(given[key]) for key in ("fx", "fy", *centre)]
    sides = next((pair for pair in _SIZES if pair[0] in given and pair[1] in given), None)
    size = (int(given[sides[0]]), int(given[sides[1]])) if sides else None
    bent = next((given[key] for key in _BENT if key in given), None)
    bent = bent.get("data") if isinstance(bent, Mapping) else bent
    if bent is None:
        bent = [given[key] for key in _BENT_BY_ONE if key in given]
    scale = given.get(_SCALE)
    scale = float(scale) if isinstance(scale, int | float) else None
    return Intrinsics(camera_of(values, where), size, any(_flat(bent)), scale)


def _flat(values: Any) -> list[float]:
    """Numbers of a list, or of a list of lists; few of both, as aliases in YAML multiply."""
    if not isinstance(values, list) or len(values) > 16:
        raise ValueError("a matrix is a list of at most 16 numbers")
    rows = [each if isinstance(each, list) else [each] for each in values]
    if any(len(row) > 16 for row in rows):
        raise ValueError("a row of a matrix has at most 16 numbers")
    return [float(value) for row in rows for value in row]
