"""Depth images with their camera, and depth, masks and intrinsics in files as people have them.

    depth        .png   grey, 16 bits, a millimetre a unit (or `scale_m`); 0: not measured
                 .npy   [h, w] of floats in metres, or of whole numbers like those of a .png;
                        0, NaN or infinite: not measured
    mask         .png   grey or with a palette; .npy [h, w] of whole numbers or bool. 0 is no
                        object, every other number is one
    intrinsics   "fx,fy,cx,cy" in pixels, or a file .json, .yaml, .txt or .npy of
                 fx fy and cx cy (or ppx ppy, as librealsense calls them);
                 K, k, camera_matrix, intrinsic_matrix or cam_K: 9 numbers, by rows (ROS, OpenCV,
                 BOP) or by columns (Open3D); perhaps width and height, which must be the picture's;
                 or 4, 9 or 16 bare numbers (TUM, ScanNet).
                 Of several YAML documents (rostopic echo) the first counts

Camera coordinates are those of `qs3.geometry.cameras`: x to the right, y down, z along the optical
axis; the centre of the top left pixel is at (0, 0). MATLAB counts pixels from 1, so a principal
point from there is one pixel less here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from annotated_types import Gt
from jaxtyping import Bool, Float, Int

from qs3.errors import DataError
from qs3.utils.files import reading
from qs3.utils.settings import settings

MOST_DEPTH_M = 100.0
MILLIMETRE = 1e-3
CAMERA_UP = np.array([0.0, -1.0, 0.0])
"""Up in the picture, in camera coordinates."""

_MILLIMETRES = (1.0, MILLIMETRE, 1000.0)  # in BOP's, librealsense's and Open3D's words
_MOST_OBJECTS = 1000  # of a mask: an image with more numbers is something else
_MATRICES = ("K", "k", "camera_matrix", "intrinsic_matrix", "intrinsics", "intrinsic", "cam_K")
_BENT = (
    *("D", "d", "coeffs", "distortion_coefficients"),
    *("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"),
)
_UNMEASURED = 65535  # what cameras that have no 0 write into 16 bits
_OFF = 0.2  # of a side, from the picture's middle
_FIELD_DEG = (2.0, 170.0)  # of view: less or more, and the unit is wrong


@settings
class Pinhole:
    """A pinhole without distortion: focal lengths and principal point in pixels."""

    fx_px: Annotated[float, Gt(0)]
    fy_px: Annotated[float, Gt(0)]
    cx_px: float
    cy_px: float

    def rays(self, height_px: int, width_px: int) -> Float[np.ndarray, "h w 3"]:
        """(x, y, 1) of each pixel: times its depth, it is the pixel's point in the camera."""
        u, v = np.meshgrid(np.arange(width_px), np.arange(height_px))
        x, y = (u - self.cx_px) / self.fx_px, (v - self.cy_px) / self.fy_px
        return np.stack([x, y, np.ones_like(x)], axis=-1)


@dataclass(frozen=True, eq=False)
class DepthImage:
    """One depth image.

    Attributes:
        depth_m: [h, w] along the optical axis; 0 where nothing was measured.
        camera: that took it.
        world_from_camera: [3, 3] rotation to a frame with z up; the camera is its origin.
        area: rows from, rows to, columns from, columns to, where the sensor can have measured at
            all; None: everywhere.
    """

    depth_m: Float[np.ndarray, "h w"]
    camera: Pinhole
    world_from_camera: Float[np.ndarray, "3 3"]
    area: tuple[int, int, int, int] | None = None

    def __post_init__(self) -> None:
        depth = np.asarray(self.depth_m)
        measured = np.isfinite(depth) & (depth > 0) & (depth < MOST_DEPTH_M)
        object.__setattr__(self, "depth_m", np.where(measured, depth, 0).astype(np.float64))
        turn = np.asarray(self.world_from_camera, dtype=np.float64)
        near = np.allclose(turn @ turn.T, np.eye(3), atol=1e-3)
        if not near or np.linalg.det(turn) < 0:
            raise DataError(f"{turn.tolist()} is not a rotation to a frame with z up")

    @cached_property
    def points_m(self) -> Float[np.ndarray, "h w 3"]:
        """Points of all pixels, z up; the camera and pixels without depth are at the origin."""
        rays = self.camera.rays(*self.depth_m.shape)
        return (rays * self.depth_m[..., None]) @ np.asarray(self.world_from_camera).T

    @cached_property
    def inside(self) -> Bool[np.ndarray, "h w"]:
        """Pixels of `area`."""
        inside = np.zeros(self.depth_m.shape, dtype=bool)
        top, bottom, left, right = self.area or (0, inside.shape[0], 0, inside.shape[1])
        inside[top:bottom, left:right] = True
        return inside


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


def upright(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation to z up whose y axis is where the camera looks, level; x is to the right.

    Of a camera that looks straight down or up, y is up in the picture or down in it. `up` is in
    camera coordinates, of any length.
    """
    z = np.asarray(up, dtype=np.float64) / float(np.linalg.norm(up))
    forward = np.array([0.0, 0.0, 1.0]) - z[2] * z
    if np.linalg.norm(forward) < 1e-6:  # z is along the optical axis, so this is level
        forward = -np.sign(z[2]) * CAMERA_UP
    y = forward / np.linalg.norm(forward)
    return np.stack([np.cross(y, z), y, z])


def read_depth(
    path: str | Path, scale_m: float | None = None, of_camera: float | None = None
) -> Float[np.ndarray, "h w"]:
    """Depth in metres, float64; 0 where nothing was measured, for which 16 bits have 65535, too.

    Args:
        path: of a .png or .npy.
        scale_m: metres a unit; None: 0.001 for whole numbers, 1 for floats.
        of_camera: `depth_scale` of the file of intrinsics. Millimetres a unit (BOP), metres a unit
            (librealsense) and units a metre (Open3D) are called so, so that it is not used, but
            whole numbers that are not millimetres by it are refused.
    """
    found = _image(Path(path), "fiu")
    whole = found.dtype.kind in "iu"
    scale = scale_m if scale_m is not None else MILLIMETRE if whole else 1.0
    depth = found.astype(np.float64) * scale
    depth[~np.isfinite(depth) | (depth < 0)] = 0
    if found.dtype.kind == "u" and found.dtype.itemsize == 2:
        depth[found == _UNMEASURED] = 0
    middle = float(np.median(depth[depth > 0])) if (depth > 0).any() else 0.0
    known = of_camera is None or any(abs(of_camera / one - 1) < 1e-3 for one in _MILLIMETRES)
    picture = found.dtype == np.uint8  # of depths
    if picture or not 0.02 < middle < MOST_DEPTH_M or (whole and scale_m is None and not known):
        raise DataError(
            f"{path}: {found.dtype}, median depth {middle:.3g} m with {scale:g} m a unit (the "
            f"intrinsics' file has {of_camera}); depth_scale=METRES gives the metres of a unit"
        )
    return depth


def read_mask(path: str | Path) -> Int[np.ndarray, "h w"]:
    """Number of the object that each pixel shows, int64; 0 where it shows none."""
    return checked_mask(_image(Path(path), "iub"), str(path))


def checked_mask(mask: np.ndarray, where: str) -> Int[np.ndarray, "h w"]:
    """A mask of whole numbers or bool as int64."""
    numbers: np.ndarray = mask.astype(np.int64)
    count = int((np.unique(numbers) != 0).sum())
    if mask.ndim != 2 or mask.dtype.kind not in "iub" or not 0 < count <= _MOST_OBJECTS:
        raise DataError(f"{where}: {mask.dtype} {mask.shape} with {count} numbers is not a mask")
    return numbers


def read_intrinsics(words: str) -> Intrinsics:
    """From "fx,fy,cx,cy" or a file."""
    if numbers := _numbers(words):
        return Intrinsics(camera_of(numbers, f"intrinsics={words}"))
    path = Path(words).expanduser()
    with reading(path):
        if path.suffix.lower() == ".npy":
            matrix = np.load(path, allow_pickle=False)
            return Intrinsics(camera_of(matrix.ravel().tolist(), str(path)))
        text = path.read_text()
        if numbers := _numbers(text):
            return Intrinsics(camera_of(numbers, str(path)))
        import yaml  # type: ignore[import-untyped,unused-ignore]

        text = text.removeprefix("%YAML:1.0").replace("!!opencv-matrix", "")
        return _of_mapping(next(yaml.safe_load_all(text)), str(path))


def camera_of(values: Sequence[float], where: str) -> Pinhole:
    """From fx fy cx cy, or the 9 or 16 numbers of a matrix."""
    values = list(values)
    if len(values) == 16:
        values = [*values[:3], *values[4:7], *values[8:11]]
    if len(values) == 9:
        if values[2] == values[5] == 0:  # by columns
            values = [values[i] for i in (0, 3, 6, 1, 4, 7, 2, 5, 8)]
        fx, skew, cx, zero, fy, cy, *last = values
        values = [] if skew or zero or last != [0, 0, 1] else [fx, fy, cx, cy]
    try:
        return Pinhole(*values)
    except (TypeError, ValueError) as error:
        raise DataError(f"{where}: expected fx,fy,cx,cy or a camera's 3 x 3 matrix") from error


def check_intrinsics(given: Intrinsics, depth_m: Float[np.ndarray, "h w"], where: str) -> str:
    """Raise DataError if this camera cannot have taken this picture, or it is in millimetres.

    Returns:
        Why the camera may be that of a picture of another size; "" if nothing says so. Lenses sit
        before the middle of their sensors to a few per cent of its sides, but of a crop the centre
        may lie anywhere. A file that has the picture's size is believed.
    """
    height, width = depth_m.shape
    camera = given.camera
    fields = np.degrees(2 * np.arctan([width / camera.fx_px / 2, height / camera.fy_px / 2]))
    # Strictly: at twice the size the middle is the corner of this picture.
    inside = -0.5 < camera.cx_px < width - 0.5 and -0.5 < camera.cy_px < height - 0.5
    seen = ((fields >= _FIELD_DEG[0]) & (fields <= _FIELD_DEG[1])).all()
    if given.size not in (None, (width, height)) or not inside or not seen:
        raise DataError(
            f"{where}: a picture of {width} x {height} px does not fit {camera}, of a field of "
            f"view of {fields[0]:.1f}° x {fields[1]:.1f}°, and pictures of {given.size}: are the "
            "intrinsics those of another resolution, or is it a crop?"
        )
    measured = depth_m[np.isfinite(depth_m) & (depth_m > 0)]
    if measured.size and (middle := float(np.median(measured))) >= MOST_DEPTH_M:
        raise DataError(f"{where}: the median depth is {middle:.4g} m; are these millimetres?")
    off = abs(camera.cx_px - (width - 1) / 2) / width, abs(camera.cy_px - (height - 1) / 2) / height
    if given.size is not None or max(off) <= _OFF:
        return ""
    return (
        f"the principal point ({camera.cx_px:g}, {camera.cy_px:g}) lies {max(off):.0%} of a side "
        f"from the middle of the picture of {width} x {height} px: unless that is a crop, the "
        "intrinsics are those of another resolution"
    )


def _image(path: Path, kinds: str) -> np.ndarray:
    """[h, w] of a .png, of a palette the numbers of its colours, or of an .npy."""
    from PIL import Image

    with reading(path):
        if path.suffix.lower() == ".npy":
            found = np.load(path, allow_pickle=False)
        else:
            with Image.open(path) as image:
                found = np.asarray(image)
        assert found.ndim == 2, f"shape {found.shape}"
        assert found.dtype.kind in kinds, f"numbers of {found.dtype}"
    return found


def _numbers(text: str) -> list[float]:
    """What nothing but numbers are, between commas or blanks; else nothing."""
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        return []


def _of_mapping(given: Mapping[str, Any], where: str) -> Intrinsics:
    matrix = next((given[key] for key in _MATRICES if key in given), None)
    if isinstance(matrix, Mapping) and "data" not in matrix:
        others = {key: value for key, value in given.items() if key not in _MATRICES}
        return _of_mapping({**others, **matrix}, where)  # the size may stand within, or about it
    if matrix is not None:
        values = _flat(matrix)
    else:
        centre = ("ppx", "ppy") if "ppx" in given else ("cx", "cy")
        values = [float(given[key]) for key in ("fx", "fy", *centre)]
    width, height = (given.get(s, given.get(f"image_{s}")) for s in ("width", "height"))
    size = (int(width), int(height)) if width and height else None
    bent = any(any(_flat(given[key])) for key in _BENT if key in given)
    scale = given.get("depth_scale")
    return Intrinsics(camera_of(values, where), size, bent, scale and float(scale))


def _flat(values: Any) -> list[float]:
    """Numbers of one, of a list, of a list of lists, or of the `data` of a mapping."""
    values = values["data"] if isinstance(values, Mapping) else values
    return [float(value) for value in np.ravel(values)]
