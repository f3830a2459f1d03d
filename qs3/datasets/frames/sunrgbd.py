"""SUN RGB-D: the frames of four sensors with their oriented boxes, one frame at a time.

Song, Lichtenberg, Xiao, "SUN RGB-D: A RGB-D Scene Understanding Benchmark Suite", CVPR 2015.

    SUNRGBDMeta3DBB_v2.mat             version 5; SUNRGBDMeta: a struct a frame, with
        depthpath, sensorType (kv1, kv2, xtion, realsense), K [3, 3], Rtilt [3, 3]
        groundtruth3DBB: structs with classname, basis [3, 3] (rows are the axes), coeffs [3] (half
                         the sizes, perhaps negative) and centroid [3], in metres
    SUNRGBDtoolbox/traintestSUNRGBD/allsplit.mat    alltrain, alltest: folders of the frames
    SUNRGBD/<sensor>/.../<frame>/depth/*.png        raw depth; depth_bfx/ has it filled in

Paths in the tables begin with a folder of the authors' machine; what follows its SUNRGBD/ counts.
`depthpath` is that of the filled depth: the raw one is the only PNG in the folder depth beside it
(its name may differ).

A depth pixel is a millimetre with its 16 bits rotated to the left by three. K counts pixels from 1.
The toolbox turns a pixel's point to (x, depth, -y), and Rtilt takes that to a frame with z up, in
which the boxes are; the camera is its origin.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from qs3.datasets.frames.cutting import Box
from qs3.datasets.frames.images import DepthImage, Pinhole
from qs3.datasets.frames.matlab import listed, load_v5, variable
from qs3.errors import DataError
from qs3.utils.pictures import png_bytes, read_png

META = "SUNRGBDMeta3DBB_v2.mat"
SPLITS = "SUNRGBDtoolbox/traintestSUNRGBD/allsplit.mat"
SENSORS = ("kv1", "kv2", "xtion", "realsense")

_ROOT = "SUNRGBD"
_SWAPPED = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""(x, y, z) of the camera to the toolbox's (x, z, -y)."""


@dataclass(frozen=True, eq=False)
class LabelledBox:
    """One box of a frame.

    Attributes:
        name: the authors' word for it.
        box: in the frame with z up; None if its numbers are none of a box.
        why: what is wrong with it then.
    """

    name: str
    box: Box | None
    why: str = ""


@dataclass(frozen=True, eq=False)
class Frame:
    """One entry of the table.

    Attributes:
        number: in the table, from 1.
        sensor: one of `SENSORS`.
        folder: of the frame, relative to the archive, e.g. "SUNRGBD/kv2/align_kv2/2014...".
        camera: of the depth image.
        world_from_camera: [3, 3] rotation to z up.
        boxes: things in it.
    """

    number: int
    sensor: str
    folder: PurePosixPath
    camera: Pinhole
    world_from_camera: np.ndarray
    boxes: tuple[LabelledBox, ...]


def read_frames(root: Path) -> list[Frame]:
    """All entries of the table of boxes.

    Raises:
        MissingDataError: there is no such file.
        DataError: it is damaged, or not this table; names the entry.
    """
    path = root / META
    entries = listed(variable(load_v5(path), "SUNRGBDMeta", path))
    if not entries:
        raise DataError(f"{path} lists no frames")
    return [_frame(one, i + 1, f"{path}, entry {i + 1}") for i, one in enumerate(entries)]


def read_splits(root: Path, splits: str = SPLITS) -> dict[PurePosixPath, str]:
    """The split of each frame, by its folder: "train" or "test".

    Raises:
        MissingDataError: there is no such file.
        DataError: it is damaged.
    """
    path = root / splits
    found = load_v5(path)
    of: dict[PurePosixPath, str] = {}
    for name, split in (("alltrain", "train"), ("alltest", "test")):
        for words in listed(variable(found, name, path)):
            of[_inner(words, f"{path}: {name}")] = split
    return of


def open_image(root: Path, frame: Frame) -> DepthImage:
    """The raw depth of a frame.

    Raises:
        DataError: it is not there, damaged, or more than one.
    """
    folder = root / Path(*frame.folder.parts) / "depth"
    if not folder.resolve().is_relative_to(root.resolve()):
        raise DataError(f"{folder} is a link that leads out of {root}; copy the files instead")
    found = sorted(p for p in folder.glob("*.png") if p.is_file()) if folder.is_dir() else []
    if len(found) != 1:
        raise DataError(
            f"{folder} holds {len(found)} PNG files, expected the one of the raw depth; unpack "
            "SUNRGBD.zip again"
        )
    (path,) = found
    if not path.resolve().is_relative_to(root.resolve()):
        raise DataError(f"{path} is a link that leads out of {root}; copy the files instead")
    try:
        depth_mm = millimetres(read_png(png_bytes(path), str(path)), str(path))
    except DataError as error:
        raise DataError(f"{error}; unpack SUNRGBD.zip again") from error
    return DepthImage(depth_mm / 1000.0, frame.camera, frame.world_from_camera)


def millimetres(rotated: np.ndarray, where: str) -> np.ndarray:
    """[h, w] float64 depth in millimetres from pixels whose bits were rotated.

    Raises:
        DataError: they are not 16 bits.
    """
    if rotated.dtype != np.uint16:
        raise DataError(f"{where}: pixels of {rotated.dtype}, expected 16 bits")
    return ((rotated >> np.uint16(3)) | (rotated << np.uint16(13))).astype(np.float64)


def _frame(entry: Any, number: int, where: str) -> Frame:
    if not isinstance(entry, dict):
        raise DataError(f"{where}: no struct; is it SUNRGBDMeta3DBB_v2.mat?")
    get = functools.partial(_field, entry, where)
    sensor = str(get("sensorType"))
    if sensor not in SENSORS:
        raise DataError(f"{where}: sensorType is {sensor!r}; known are {', '.join(SENSORS)}")
    k = _numbers(get("K"), (3, 3), f"{where}: K")
    tilt = _numbers(get("Rtilt"), (3, 3), f"{where}: Rtilt")
    boxes = [one for one in listed(entry.get("groundtruth3DBB", [])) if isinstance(one, dict)]
    try:
        camera = Pinhole(k[0, 0], k[1, 1], k[0, 2] - 1, k[1, 2] - 1)
    except DataError as error:
        raise DataError(f"{where}: {error}") from error
    return Frame(
        number,
        sensor,
        _inner(get("depthpath"), where).parent.parent,
        camera,
        tilt @ _SWAPPED,
        tuple(map(_box, boxes)),
    )


def _box(entry: dict[str, Any]) -> LabelledBox:
    """One of thousands that people drew: one that is not a box costs only itself."""
    name = str(entry.get("classname", ""))
    try:
        axes = _numbers(_field(entry, "the box", "basis"), (3, 3), "its basis")
        half = np.abs(_numbers(_field(entry, "the box", "coeffs"), (3,), "its coeffs"))
        centre = _numbers(_field(entry, "the box", "centroid"), (3,), "its centroid")
        if not np.allclose(axes @ axes.T, np.eye(3), atol=0.05):
            raise DataError(f"its basis {axes.round(3).tolist()} is not three directions")
    except DataError as error:
        return LabelledBox(name, None, str(error))
    return LabelledBox(name, Box(centre, axes, half))


def _field(entry: dict[str, Any], where: str, name: str) -> Any:
    if name not in entry:
        raise DataError(f"{where}: no field {name!r}; it has {', '.join(sorted(entry))}")
    return entry[name]


def _numbers(value: Any, shape: Sequence[int], where: str) -> np.ndarray:
    try:
        found = np.asarray(value, dtype=np.float64).reshape(shape)
    except (TypeError, ValueError) as error:
        raise DataError(f"{where} is not numbers {list(shape)}") from error
    if not np.isfinite(found).all():
        raise DataError(f"{where} is not finite")
    return found


def _inner(words: Any, where: str) -> PurePosixPath:
    """What follows SUNRGBD/ in a path of the authors' machine, with it."""
    parts = [part for part in str(words).split("/") if part not in ("", ".")]
    if ".." in parts or _ROOT not in parts or parts[-1] == _ROOT:
        raise DataError(f"{where}: the path {str(words)!r} leads nowhere in {_ROOT}/")
    return PurePosixPath(*parts[parts.index(_ROOT) :])
