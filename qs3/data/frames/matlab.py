"""MATLAB's files, read with distrust: version 5 to 7 by scipy, 7.3 (which is HDF5) by h5py.

Both readers give plain arrays and strings. Sizes are judged before memory is taken, links and
datasets that lie in other files are refused, and nothing in a file is ever executed: objects of
MATLAB's classes stay unread.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import DataError, MissingDataError

_MOST_V5_BYTES = 1 << 28
_MOST_WORDS = 1 << 17
_MOST_LETTERS = 1 << 12
AGAIN = "download it again"


def load_v5(path: Path) -> dict[str, Any]:
    """The variables of a MATLAB file of version 5 to 7; structs are dicts, cells are lists.

    Raises:
        MissingDataError: there is no such file.
        DataError: it is too large, damaged, or of another format.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    if not path.is_file():
        raise MissingDataError(f"there is no {path}")
    if (size := path.stat().st_size) > _MOST_V5_BYTES:
        raise DataError(f"{path} has {size} bytes, more than the {_MOST_V5_BYTES} that are read")
    try:
        found = loadmat(path, simplify_cells=True, mat_dtype=False)
    except NotImplementedError as error:
        raise DataError(
            f"{path} is a MATLAB file of version 7.3, where one of version 5 to 7 was published; "
            "save it with -v7"
        ) from error
    except (MatReadError, ValueError, TypeError, KeyError, IndexError, OSError, EOFError) as error:
        raise DataError(f"{path} is not a readable MATLAB file ({error}); {AGAIN}") from error
    except (zlib.error, MemoryError, OverflowError, AttributeError) as error:
        raise DataError(f"{path} is damaged ({error}); {AGAIN}") from error
    return {key: value for key, value in found.items() if not key.startswith("__")}


def variable(found: dict[str, Any], name: str, path: Path) -> Any:
    """One variable of what `load_v5` gave.

    Raises:
        DataError: there is none of this name; lists those that there are.
    """
    if name not in found:
        raise DataError(f"{path} has no variable {name!r}; it has {', '.join(found) or 'none'}")
    return found[name]


def listed(value: Any) -> list[Any]:
    """A struct array or cell array as a list: one element comes alone, none as an empty array."""
    if isinstance(value, np.ndarray):
        return list(value.ravel())
    return list(value) if isinstance(value, list | tuple) else [value]


def own_array(file: Any, name: str, path: Path) -> Any:
    """A dataset of an HDF5 file whose numbers are in this very file.

    Raises:
        DataError: there is none, or it lies elsewhere.
    """
    from qs3.clouds.hdf5 import own_dataset

    found = own_dataset(file, (name,), path)
    if found is None:
        raise DataError(f"{path} has no variable {name!r}; it has {', '.join(sorted(file))}")
    return found


def words(file: Any, name: str, path: Path) -> list[str]:
    """A cell array of text in a file of version 7.3: references to arrays of letters.

    Raises:
        DataError: it is something else.
    """
    import h5py

    cells = own_array(file, name, path)
    if cells.dtype != h5py.ref_dtype or not 1 <= cells.size <= _MOST_WORDS:
        raise DataError(f"{path}: {name} is {cells.dtype} {cells.shape}, not a list of text")
    found = []
    for i, reference in enumerate(cells[...].ravel()):
        text: Any = file[reference] if reference else None
        plain = isinstance(text, h5py.Dataset) and text.dtype.kind == "u"
        if not plain or text.size > _MOST_LETTERS or text.external or text.is_virtual:
            raise DataError(f"{path}: {name}, number {i + 1}, is not text")
        empty = text.attrs.get("MATLAB_empty", 0)  # its numbers are then the size, 0 by 0
        letters = [] if empty else text[...].ravel(order="F").tolist()
        try:
            found.append("".join(map(chr, letters)))
        except (ValueError, OverflowError) as error:
            raise DataError(f"{path}: {name}, number {i + 1}, is not text") from error
    return found
