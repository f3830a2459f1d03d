"""MATLAB's files, read with distrust: version 5 to 7 by scipy, 7.3 (which is HDF5) by h5py.

Both readers give plain arrays and strings. Sizes are judged before memory is taken, links and
datasets that lie in other files are refused, and nothing in a file is ever executed: objects of
MATLAB's classes stay unread.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path
from typing import Any, Literal

import numpy as np

from qs3.errors import DataError, MissingDataError
from qs3.utils.memory import check_memory, memory_limit, read_whole

_MOST_V5_BYTES = 1 << 28
_PEAK_V5 = 8  # of memory to what is unpacked: small arrays are objects; 4.1 of SUN RGB-D's table
_MOST_DEPTH = 16
_INT8, _INT32, _UINT32, _MATRIX, _COMPRESSED = 1, 5, 6, 14, 15  # types of elements
_NUMBERS, _LETTERS = {*range(1, 8), 9, 12, 13}, {16, 17, 18}
_CELL, _STRUCT, _CHAR = 1, 2, 4  # classes of variables
_PLAIN = {_CHAR, *range(6, 16)}  # objects, functions and sparse matrices are in no published file
_ORDERS: dict[bytes, Literal["little", "big"]] = {b"\x00\x01IM": "little", b"\x01\x00MI": "big"}
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
        _check_v5(path)
        found = loadmat(path, simplify_cells=True, mat_dtype=False)
    except (MatReadError, ValueError, TypeError, KeyError, IndexError, OSError, EOFError) as error:
        raise DataError(f"{path} is not a readable MATLAB file ({error}); {AGAIN}") from error
    except (zlib.error, MemoryError, OverflowError, AttributeError, NameError) as error:
        raise DataError(f"{path} is damaged ({error}); {AGAIN}") from error
    return {key: value for key, value in found.items() if not key.startswith("__")}


def _check_v5(path: Path) -> None:
    """Compare lengths and types with what there can be: over wrong ones scipy ends the process.

    The format is described in "MAT-File Format" (The MathWorks): a header of 128 bytes, then
    elements, each a tag (type and bytes) and its bytes, padded to 8; a matrix holds elements.

    Raises:
        DataError: of another version.
        ValueError: a length does not fit.
    """
    data = memoryview(read_whole(path, _PEAK_V5))
    order = _ORDERS.get(bytes(data[124:128]))
    if bytes(data[124:128]) in (b"\x00\x02IM", b"\x02\x00MI"):
        raise DataError(
            f"{path} is a MATLAB file of version 7.3, where one of version 5 to 7 was published; "
            "save it with -v7"
        )
    if order is None or 0 in data[:4]:  # a zero: version 4
        raise ValueError("its header is not that of version 5")
    at = 128
    while at < len(data):
        kind, body, at = _element(data, at, order)
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            check_memory(_PEAK_V5 * len(body), path)
            limit = memory_limit() // _PEAK_V5
            unpacked = memoryview(unpacker.decompress(body, limit + 1))
            check_memory(_PEAK_V5 * len(unpacked), path)
            kind, body, _ = _element(unpacked, 0, order)
        if kind != _MATRIX:
            raise ValueError(f"an element of type {kind} where a variable should be")
        _check_matrix(body, order)


def _check_matrix(body: memoryview, order: Literal["little", "big"], depth: int = 0) -> None:
    """Raise ValueError unless what is in it, and in matrices within, is of its kind and fits."""
    if not len(body):
        return  # how an empty cell is written
    if depth > _MOST_DEPTH:
        raise ValueError("cells within cells without end")
    parts, at = [], 0
    while at < len(body):
        kind, inner, at = _element(body, at, order)
        parts.append((kind, inner))
    kinds = [kind for kind, _ in parts]
    if kinds[:3] != [_UINT32, _INT32, _INT8] or len(parts[0][1]) != 8:
        raise ValueError("a matrix without kind, size and name")
    flags = int.from_bytes(parts[0][1][:4], order)
    sides = np.frombuffer(parts[1][1], "<i4" if order == "little" else ">i4").tolist()
    if min(sides, default=-1) < 0 or (count := math.prod(sides)) > len(body):
        raise ValueError(f"an array of {sides} in {len(body)} bytes")
    class_, content = flags & 0xFF, kinds[3:]
    if class_ == _CELL:
        fits = content == [_MATRIX] * count
    elif class_ == _STRUCT:
        sizes = [len(inner) for _, inner in parts[3:5]]
        width = int.from_bytes(parts[3][1], order) if sizes[:1] == [4] else 0
        fields = sizes[1] // width if width and len(sizes) == 2 else 0
        fits = content == [_INT32, _INT8] + [_MATRIX] * count * fields
    else:
        allowed = _NUMBERS | _LETTERS if class_ == _CHAR else _NUMBERS
        complex_ = bool(flags & 0x800)
        fits = class_ in _PLAIN and len(content) == 1 + complex_ and {*content} <= allowed
    if not fits:
        raise ValueError(f"a variable of class {class_} with parts of the types {content[:9]}")
    for kind, inner in parts:
        if kind == _MATRIX:
            _check_matrix(inner, order, depth + 1)


def _element(
    data: memoryview, at: int, order: Literal["little", "big"]
) -> tuple[int, memoryview, int]:
    """Type and bytes of the element at a place, and the place of the next; ValueError if cut."""
    kind, size = (int.from_bytes(data[at + i : at + i + 4], order) for i in (0, 4))
    begin, short = at + 8, kind >> 16
    if short:  # up to 4 bytes within the tag
        kind, size, begin = kind & 0xFFFF, short, at + 4
    end = begin + size
    if short > 4 or len(data) < max(end, at + 8):
        raise ValueError(f"an element of {size} bytes is cut off")
    after = at + 8 if short else end if kind == _COMPRESSED else end + -size % 8
    return kind, data[begin:end], after


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
    from qs3.datasets.clouds.hdf5 import own_dataset

    found = own_dataset(file, (name,), path)
    if found is None:
        there = ", ".join(sorted(map(str, file)))  # some are bytes
        raise DataError(f"{path} has no variable {name!r}; it has {there}")
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
