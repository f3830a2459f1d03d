"""Point clouds of any number of points from files in the usual formats; files are not trusted.

    .xyz .txt   text, a row a point: x y z and perhaps more columns, by blanks, commas or
                semicolons; # and // begin a comment
    .npy        [n, >= 3], or [m, n, >= 3]: m clouds, unless m and n are a depth camera's height
                and width, as of one organised cloud: that is refused, as are depth images
                (more than 32 columns) and [3, n], x y z as rows. Or [n] or [m, n] of records with
                the fields x, y, z
    .npz        the array `points` (or the only one) as in .npy; perhaps `label` or `cls`
    .ply        the vertices, text or binary; faces are passed over
    .pcd        x y z
    .h5 .hdf5   the dataset `data` or `points` as in .npy; perhaps `label`

Only x y z are read, as they are: `qs3.datasets.clouds.finite` judges the numbers. Pickled arrays
are refused
unopened, and what takes more memory than `qs3.utils.memory` allows, before it is taken. Whatever is
wrong with a file, the error is a DataError.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.datasets.clouds.arrays import npy_header, read_npy, read_npz
from qs3.datasets.clouds.hdf5 import read_hdf5
from qs3.datasets.clouds.pcd import read_pcd
from qs3.datasets.clouds.shape import check_shape
from qs3.datasets.clouds.text import read_text
from qs3.errors import DataError, MeshError, Qs3Error
from qs3.utils.memory import check_memory
from qs3.utils.plural import counted
from qs3.utils.text_table import printable


@dataclass(frozen=True, eq=False)
class CloudFile:
    """What a file holds.

    Attributes:
        clouds: [n, 3] each, of any numbers.
        labels: of each cloud as the file has them, a number or a word; None if it has none.
        many: whether the file is made for several clouds (then each has a number in its name).
    """

    clouds: tuple[np.ndarray, ...]
    labels: tuple[Any, ...] | None = None
    many: bool = False


def parse_clouds(path: str | Path) -> CloudFile:
    """All clouds of a file with the numbers that it holds; they are not looked at.

    Raises:
        DataError: names the file, and the line.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(f"{path}: unknown format; known are {', '.join(SUFFIXES)}")
    try:
        if not (size := path.stat().st_size):
            raise DataError(f"{path}: 0 bytes, there are no points")
        check_memory(2 * size, path)
        found = reader(path)
    except Qs3Error:
        raise
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror or error})") from error
    except Exception as error:  # what damaged bytes do to a reader cannot be listed
        raise DataError(f"{path} cannot be read ({type(error).__name__}: {error})") from error
    if not found.clouds:
        raise DataError(f"{path}: there are no clouds")
    return found


def parse_cloud(path: str | Path) -> np.ndarray:
    """[n, 3] as they are in the file: the one cloud in it; see `parse_clouds`.

    Raises:
        DataError: names the file, and the line; or it holds several clouds.
    """
    found = parse_clouds(path)
    if len(found.clouds) != 1:
        raise DataError(f"{path} holds {len(found.clouds)} clouds, expected one")
    return found.clouds[0]


def npy_clouds(path: Path) -> int | None:
    """How many clouds an .npy file is made for, from its header alone; None: a single one.

    Raises:
        DataError: as `parse_clouds`.
    """
    shape, dtype = npy_header(path)
    if fields := _fields(path, dtype):
        shape, dtype = (*shape, len(fields)), np.result_type(*(dtype[name] for name in fields))
    _check_array(path, shape, dtype)
    if len(shape) == 3 and not shape[0]:
        raise DataError(f"{path}: there are no clouds")
    return shape[0] if len(shape) == 3 else None


def _text(path: Path) -> CloudFile:
    return CloudFile((read_text(path),))


def _npy(path: Path) -> CloudFile:
    return _of_array(path, read_npy(path))


def _npz(path: Path) -> CloudFile:
    def choose(names: list[str]) -> list[str]:
        key = "points" if "points" in names else names[0] if len(names) == 1 else None
        if key is None:
            raise DataError(f"{path} has no array 'points'; it has {', '.join(names)}")
        return [key, *[name for name in ("cls", "label", "labels") if name in names][:1]]

    array, *labels = read_npz(path, choose).values()
    return _of_array(path, array, labels[0] if labels else None)


def _ply(path: Path) -> CloudFile:
    from qs3.meshes.formats.ply import read_vertices

    try:
        return CloudFile((read_vertices(path.read_bytes()),))
    except MeshError as error:
        raise DataError(f"{path} {error}") from error


def _pcd(path: Path) -> CloudFile:
    try:
        points = read_pcd(path).xyz()
    except DataError as error:
        raise error if str(path) in str(error) else DataError(f"{path}: {error}") from error
    return CloudFile((points,))


def _hdf5(path: Path) -> CloudFile:
    return _of_array(path, *read_hdf5(path, functools.partial(_check_array, path)))


def _fields(path: Path, dtype: np.dtype) -> list[str]:
    """Of records, the fields x, y, z; of plain numbers none. Else DataError."""
    if dtype.names is None:
        return []
    found = [name for axis in "xyz" for name in dtype.names if name.lower() == axis]
    if [name.lower() for name in found] != list("xyz") or any(
        dtype[name].kind not in "fiu" for name in found
    ):
        names = printable(", ".join(dtype.names[:8]))
        raise DataError(f"{path}: records of {names}: which are numbers x, y and z?")
    return found


def _of_array(path: Path, array: np.ndarray, labels: np.ndarray | None = None) -> CloudFile:
    if fields := _fields(path, array.dtype):
        array = np.stack([array[name] for name in fields], axis=-1)
    _check_array(path, array.shape, array.dtype)
    many = array.ndim == 3
    clouds = array[..., :3] if many else array[None, :, :3]
    if labels is not None and labels.shape != (len(clouds),):
        raise DataError(
            f"{path}: {counted(len(clouds), 'cloud')}, but the labels have the shape {labels.shape}"
        )
    words = None if labels is None else tuple(labels.tolist())
    return CloudFile(tuple(clouds), words, many=many)


def _check_array(path: Path, shape: tuple[int, ...] | None, dtype: np.dtype) -> None:
    if shape is None:  # of HDF5
        raise DataError(f"{path}: the dataset is empty")
    if dtype.kind not in "fiu":
        raise DataError(f"{path}: the array holds {dtype}, not numbers")
    if len(shape) not in (2, 3) or shape[-1] < 3:
        raise DataError(f"{path}: the array has shape {shape}, expected [n, 3] or [m, n, 3]")
    check_shape(path, shape)
    if len(shape) == 3 and shape[:2] in _PICTURES:
        raise DataError(
            f"{path}: the array has shape {shape}: is it one organised cloud, of a depth camera "
            f"with {shape[1]} x {shape[0]} px? Then save cloud.reshape(-1, {shape[2]}); if it is "
            f"{shape[0]} clouds, save them in two files"
        )


_PICTURES = {
    *((240, 320), (480, 640), (424, 512), (576, 640), (270, 480), (360, 640), (480, 848)),
    *((540, 960), (720, 1280), (960, 1280), (1080, 1920)),
}
"""Height and width of depth cameras' pictures; so many clouds of so many points are not likely."""

_READERS: dict[str, Callable[[Path], CloudFile]] = {
    **{".xyz": _text, ".txt": _text, ".npy": _npy, ".npz": _npz, ".ply": _ply, ".pcd": _pcd},
    **{".h5": _hdf5, ".hdf5": _hdf5},
}
SUFFIXES: tuple[str, ...] = tuple(_READERS)
"""Suffixes of the formats that are read, in lower case."""
