"""HDF5, not trusted: a file can take its numbers from others, and be small and unpack to much."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import DataError
from qs3.utils.memory import check_memory


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
    import h5py

    try:
        with h5py.File(path, "r") as file:
            data = own_dataset(file, ("data", "points"), path)
            if data is None:
                raise DataError(f"{path} has no dataset 'data' or 'points'")
            check(data.shape, data.dtype)
            label = own_dataset(file, ("label", "labels"), path)
            check_memory(2 * data.size * data.dtype.itemsize, path)
            labels = None if label is None else _labels(label, path)
            array = np.asarray(data[...])
    except (OSError, RuntimeError, ValueError, KeyError, MemoryError) as error:
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
