"""Files of numpy, not trusted: nothing is unpickled, and no memory taken for what is not there."""

from __future__ import annotations

import contextlib
import io
import math
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import DataError
from qs3.utils.memory import check_memory


def read_npy(
    path: Path, check: Callable[[tuple[int, ...], np.dtype], None] | None = None
) -> np.ndarray:
    """The array of an .npy file, of any shape and type but objects.

    Args:
        path: of the file.
        check: of shape and type, before memory is taken; raises DataError.

    Raises:
        DataError: damaged, pickled, or of another size than its header says; what `check` raises.
    """
    with _readable(path, ".npy file"), open(path, "rb") as file:
        size = path.stat().st_size
        check_memory(2 * size, path)
        shape, dtype = _header(path, file, size)
        if check:
            check(shape, dtype)
        file.seek(0)
        array: np.ndarray = np.load(file, allow_pickle=False)
        _check_words(path, array)
    return array


def npy_header(path: Path) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of an .npy file's array, read from its header alone.

    Raises:
        DataError: as `read_npy`.
    """
    with _readable(path, ".npy file"), open(path, "rb") as file:
        return _header(path, file, path.stat().st_size)


def read_npz(path: Path, choose: Callable[[list[str]], Sequence[str]]) -> dict[str, np.ndarray]:
    """Some arrays of an .npz, of any shape and type but objects.

    Args:
        path: of the file.
        choose: which, of the names of all; may raise DataError.

    Raises:
        DataError: damaged, pickled, or larger than `qs3.utils.memory` allows or its parts are.
    """
    arrays, needed = {}, 0
    with _readable(path, ".npz of plain arrays"), zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        for name in choose(list(members)):
            info = members[name]
            check_memory(needed := needed + 2 * info.file_size, path)
            # Whole: of a stream numpy would make the array that the header promises.
            data = archive.read(info)
            _header(f"{path}, {name}", io.BytesIO(data), len(data))
            arrays[name] = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
            _check_words(f"{path}, {name}", arrays[name])
    return arrays


def _header(where: object, file: Any, size: int) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of numbers, after comparing them with the size of the whole in bytes."""
    version = np.lib.format.read_magic(file)
    read: Callable[..., Any] | None = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read is None:
        raise ValueError(f"version {version} of the .npy format")
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise DataError(f"{where}: a pickled array, refused; save it as plain numbers")
    expected = file.tell() + dtype.itemsize * math.prod(shape)
    if size != expected or min(shape, default=0) < 0:
        raise DataError(f"{where}: {size} bytes, expected {expected} for shape {shape}")
    return shape, dtype


def _check_words(where: object, array: np.ndarray) -> None:
    """Refuse words of letters that do not exist: Python fails at them, wherever it meets them."""
    if array.dtype.kind == "U" and array.dtype.itemsize:
        letters = np.ascontiguousarray(array).reshape(-1).view(array.dtype.str[0] + "u4")
        if ((letters > 0x10FFFF) | ((letters >= 0xD800) & (letters < 0xE000))).any():
            raise DataError(f"{where}: its words hold letters that do not exist")


@contextlib.contextmanager
def _readable(path: Path, what: str) -> Iterator[None]:
    """Turn what numpy raises on damaged files, of a dozen kinds, into a DataError."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a header written by Python 2
            yield
    except DataError:
        raise
    except Exception as error:
        raise DataError(f"{path}: not a readable {what} ({error})") from error
