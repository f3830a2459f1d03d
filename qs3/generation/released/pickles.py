"""Untrusted pickled dicts, as numpy saves them, read without running what they ask for.

A pickle is a program. Only the instructions for plain values are let through, and of the names
that it may call only the two that make arrays. Even these are not numpy's here: an array is made
when its size was compared with the bytes that are there.
"""

from __future__ import annotations

import io
import math
import pickle
import re
from typing import Any

import numpy as np

from qs3.errors import DataError

MAX_BYTES = 1 << 20
_MOST_SIDES = 32  # of an array: numpy's own limit
_NAMES = (  # instructions of protocols 3 and 4 for plain values, and calls
    "PROTO FRAME STOP MARK MEMOIZE BINPUT LONG_BINPUT BINGET LONG_BINGET NONE NEWTRUE NEWFALSE "
    "BININT BININT1 BININT2 LONG1 BINFLOAT BINUNICODE SHORT_BINUNICODE BINBYTES SHORT_BINBYTES "
    "EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_LIST APPEND APPENDS EMPTY_DICT SETITEM SETITEMS "
    "GLOBAL STACK_GLOBAL REDUCE BUILD"
)
_CODES = [getattr(pickle, name)[0] for name in _NAMES.split()]


def load_npy_object(data: bytes, name: str) -> Any:
    """The value in a .npy file that numpy wrote with `allow_pickle=True` from a single object.

    Args:
        data: the file, at most `MAX_BYTES`.
        name: of the file, for messages.

    Returns:
        Plain values, with numpy arrays of numbers among them.

    Raises:
        DataError: no such file, damaged, or it asks for more than plain values and arrays.
    """
    if len(data) > MAX_BYTES:
        raise DataError(f"{name} has {len(data)} bytes; more than {MAX_BYTES} are not read")
    file = io.BytesIO(data)
    try:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError("another version of the format")
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    except Exception as error:  # numpy's parser of headers raises whatever Python's does
        raise DataError(f"{name} is not a .npy file: {error}") from error
    if shape != () or not dtype.hasobject:
        raise DataError(f"{name} holds an array of {dtype} {shape}, not one pickled object")
    try:
        array = _Unpickler(file).load()
    except Exception as error:  # a damaged pickle can raise whatever it stumbles over
        why = error if isinstance(error, DataError) else f"{type(error).__name__}: {error}"
        raise DataError(
            f"{name} is damaged, or its pickle asks for more than plain values and arrays of "
            f"numbers, and nothing of that is run: {why}"
        ) from error
    if not isinstance(array, np.ndarray) or not array.dtype.hasobject:
        raise DataError(f"{name}: its header and its content contradict each other")
    return array[()]


class _Type:
    """Stands for numpy.dtype."""

    def __init__(self, code: str, align: bool, copy: bool) -> None:
        if not re.fullmatch(r"[fiu][1248]|b1|O8", code):
            raise DataError(f"an array of type {code!r}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: tuple) -> None:
        if any(state[2:5]):
            raise DataError("an array with fields")
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array(np.ndarray):
    def __setstate__(self, state: tuple) -> None:
        _, shape, kind, column_major, content = state
        if len(shape) > _MOST_SIDES or any(type(n) is not int or n > MAX_BYTES for n in shape):
            raise DataError("an array of no such shape")
        dtype, sides = kind.dtype, [*shape, 1]
        if dtype.hasobject:
            whole = shape == () and type(content) is list and len(content) == 1
        else:
            size = math.prod(sides) * dtype.itemsize
            whole = min(sides) >= 0 and type(content) is bytes and len(content) == size
        if not whole:
            raise DataError(f"an array of shape {shape!r:.80} that is cut off")
        super().__setstate__((1, shape, dtype, bool(column_major), content))


class _Memo(dict):
    """Gives names, texts and types again, but no values: shared ones can multiply without end."""

    def __getitem__(self, key: int) -> Any:
        value = super().__getitem__(key)
        if isinstance(value, list | dict | tuple | np.ndarray):
            raise DataError("a value at two places")
        return value


# Python's own: that in C reserves whatever a length promises. Any: its parts have no types.
_PythonUnpickler: Any = pickle._Unpickler


class _Unpickler(_PythonUnpickler):
    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.memo = _Memo()

    def find_class(self, module: str, name: str) -> Any:
        core = module in ("numpy.core.multiarray", "numpy._core.multiarray")
        if core and name == "_reconstruct":
            return lambda *_: np.ndarray.__new__(_Array, (0,))
        if module == "numpy" and name in ("dtype", "ndarray"):
            return _Type if name == "dtype" else name
        raise DataError(f"{module}.{name}")

    def load_setitem(self) -> None:
        _check_keys(self.stack[-2:-1])
        super().load_setitem()

    def load_setitems(self) -> None:
        _check_keys(self.stack[::2])
        super().load_setitems()

    def load_build(self) -> None:
        if not isinstance(self.stack[-2], _Type | _Array):
            raise DataError("a state for what has none")
        super().load_build()

    dispatch = {code: _PythonUnpickler.dispatch[code] for code in _CODES}  # noqa: RUF012
    dispatch[pickle.BUILD[0]] = load_build
    dispatch[pickle.SETITEM[0]] = load_setitem
    dispatch[pickle.SETITEMS[0]] = load_setitems


def _check_keys(keys: list[Any]) -> None:
    """Refuse keys but strings: to find a tuple of tuples, all of it is looked through."""
    if any(type(key) is not str for key in keys):
        raise DataError("a key that is not a string")
