"""HDF5, not trusted: a file can take its numbers from others, and be small and unpack to much."""

from __future__ import annotations

import mmap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import DataError
from qs3.utils.memory import check_memory

HDF5_DAMAGE = (OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError)
"""What h5py raises for damaged files."""

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_HEAP = b"HEAP"
_NO_BLOCK = 1  # ends a list of free blocks


def open_hdf5(path: Path) -> Any:
    """An `h5py.File` to read from, which the caller closes.

    Raises:
        DataError: a list in the file leads back to itself, which libhdf5 would follow until the
            memory is full.
        One of HDF5_DAMAGE: damaged.
    """
    import h5py

    check_heaps(path)
    return h5py.File(path, "r")


def check_heaps(path: Path) -> None:
    """Raise DataError if the free blocks of a local heap, a chain in the file, have no end.

    "HDF5 File Format Specification", III.D, local heaps: signature, version, size of the data
    segment, its first free block, its address; a free block begins with the next one's offset.
    """
    with open(path, "rb") as file:
        if not file.seek(0, 2):
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            begin = _superblock(data)
            at = data.find(_HEAP) if begin is not None else -1
            while begin is not None and at >= 0:
                if _endless(data, at, *begin):
                    raise DataError(f"{path}: the heap at byte {at} is a circle; it is damaged")
                at = data.find(_HEAP, at + 1)


def _superblock(data: mmap.mmap) -> tuple[int, int, int] | None:
    """Where it is, from which addresses count, and their bytes and a length's; None: nowhere."""
    at = 0
    while at + 16 <= len(data):
        if data[at : at + 8] == _SIGNATURE:
            first = at + (13 if data[at + 8] < 2 else 9)
            return at, data[first], data[first + 1]
        at = max(512, 2 * at)
    return None


def _endless(data: mmap.mmap, heap: int, base: int, of_address: int, of_length: int) -> bool:
    """Whether the chain of a heap's free blocks comes to a block that it was at before."""

    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size], "little")

    size, block = number(heap + 8, of_length), number(heap + 8 + of_length, of_length)
    segment = base + number(heap + 8 + 2 * of_length, of_address)
    seen: set[int] = set()
    while block != _NO_BLOCK and block + 2 * of_length <= min(size, len(data) - segment):
        if block in seen:
            return True
        seen.add(block)
        block = number(segment + block, of_length)
    return False


def read_hdf5(
    path: Path, check: Callable[[tuple[int, ...] | None, np.dtype], None]
) -> tuple[np.ndarray, np.ndarray | None]:
    """The dataset `data` or `points`, and [n] of `label` or `labels`, if there is one.

    Args:
        path: of the file.
        check: of shape (None: it is empty) and type, before memory is taken; raises DataError.

    Raises:
        DataError: damaged, not there, or in other files; what `check` raises.
    """
    try:
        with open_hdf5(path) as file:
            data = own_dataset(file, ("data", "points"), path)
            if data is None:
                raise DataError(f"{path} has no dataset 'data' or 'points'")
            check(data.shape, data.dtype)
            label = own_dataset(file, ("label", "labels"), path)
            check_memory(2 * data.size * data.dtype.itemsize, path)
            labels = None if label is None else _labels(label, path)
            array = np.asarray(data[...])
    except HDF5_DAMAGE as error:
        raise DataError(f"{path}: not a readable HDF5 file ({error})") from error
    return array, labels


def own_dataset(file: Any, names: tuple[str, ...], path: Path) -> Any:
    """The first of the named datasets whose numbers are in this very file; None if there is none.

    Raises:
        DataError: it takes them from other files, as HDF5 can.
    """
    import h5py

    name = next((name for name in names if name in file), None)
    if name is None:
        return None
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise DataError(f"{path}: {name!r} is a link; refused")
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise DataError(f"{path}: {name!r} is not a dataset")
    if found.external or found.is_virtual:
        raise DataError(f"{path}: {name!r} takes its numbers from other files; refused")
    return found


def _labels(label: Any, path: Path) -> np.ndarray:
    """[n] of a dataset of n numbers or words."""
    if label.shape is None:
        raise DataError(f"{path}: the dataset of labels is empty")
    check_memory(label.size * (label.dtype.itemsize + 50), path)
    if not label.dtype.hasobject:
        return np.asarray(label[...]).reshape(-1)
    words, size = [], 0  # of any length, and the same one may stand at many places
    for place in np.ndindex(label.shape):
        words.append(label[place])
        check_memory(size := size + len(words[-1]), path)
    found = np.empty(len(words), dtype=object)
    found[:] = words
    return found
