"""Pickled values of strangers, read without running anything that they ask for.

A pickle is a program. Of its instructions only those that build plain values are let through,
and of the names that it may call only the few that numpy writes for arrays. Even those are not
numpy's here: they are inert stand-ins that note what was asked for, and an array is made from
the notes afterwards, when its size has been compared with the bytes that are there.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
import warnings
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from qs3.errors import DataError

MAX_BYTES = 1 << 20
_MAX_VALUES = 100_000
_MAX_DEPTH = 20

# What pickle writes for None, bool, int, float, text, bytes, tuple, list, dict and for objects
# that are made by a call. Not among them: persistent ids, registered extensions, classes made
# without a call, out-of-band buffers.
# fmt: off
_INSTRUCTIONS = frozenset((
    "PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK", "DUP", "MEMOIZE",
    "PUT", "BINPUT", "LONG_BINPUT", "GET", "BINGET", "LONG_BINGET",
    "NONE", "NEWTRUE", "NEWFALSE", "INT", "BININT", "BININT1", "BININT2",
    "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT",
    "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8",
    "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BINSTRING", "SHORT_BINSTRING",
    "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3",
    "EMPTY_LIST", "LIST", "APPEND", "APPENDS", "EMPTY_DICT", "DICT", "SETITEM", "SETITEMS",
    "GLOBAL", "STACK_GLOBAL", "REDUCE", "BUILD",
))
# fmt: on
_PUT = ("PUT", "BINPUT", "LONG_BINPUT")
_TYPE = re.compile(r"[<>|=]?(?:O8?|f[248]|[iu][1248]|b1|\?)")


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
    _check_size(data, name)
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        else:
            shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    except ValueError as error:
        raise DataError(f"{name} is no .npy file: {error}") from error
    if shape != () or dtype != np.dtype(object):
        raise DataError(
            f"{name} holds an array of {dtype} {shape}, not one pickled object: it is of another "
            "format"
        )
    array = loads(data[file.tell() :], name)
    if not isinstance(array, np.ndarray) or array.shape != () or not array.dtype.hasobject:
        raise DataError(f"{name}: its header and its content contradict each other")
    return array[()]


def loads(data: bytes, name: str) -> Any:
    """The value of a pickle that holds plain values and numpy arrays only.

    Args:
        data: the pickle, at most `MAX_BYTES`.
        name: of the file, for messages.

    Raises:
        DataError: damaged, or it asks for anything else; nothing that it asks for is run.
    """
    _check_size(data, name)
    _check_instructions(data, name)
    try:
        value = _Unpickler(data, name).load()
    except DataError as error:
        message = str(error)
        raise DataError(message if name in message else f"{name}: {message}") from error
    except Exception as error:  # a damaged pickle can raise whatever it stumbles over
        raise DataError(f"{name} is damaged: {type(error).__name__}: {error}") from error
    return _Builder(name).build(value)


def _check_size(data: bytes, name: str) -> None:
    if len(data) > MAX_BYTES:
        raise DataError(f"{name} has {len(data)} bytes; more than {MAX_BYTES} are not read")


def _check_instructions(data: bytes, name: str) -> None:
    """Refuse instructions that plain values do not need, before any is carried out.

    An entry in the memo far beyond its size would make the interpreter reserve that much memory.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of text with odd escapes
            instructions = list(pickletools.genops(data))
        for code, argument, _ in instructions:
            if code.name not in _INSTRUCTIONS:
                raise DataError(
                    f"{name}: its pickle uses {code.name}, which plain values do not need; refused"
                )
            if code.name in _PUT and int(argument or 0) > len(data):
                raise DataError(f"{name} is damaged: memo entry {argument} of {len(data)} bytes")
    except (ValueError, IndexError, UnicodeError, OverflowError, Warning) as error:
        raise DataError(f"{name} is damaged: {error}") from error


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, name: str) -> None:
        super().__init__(io.BytesIO(data), fix_imports=False, encoding="bytes")
        self._name = name

    def find_class(self, module: str, name: str) -> Any:
        found = _STAND_INS.get((module, name))
        if found is None:
            raise DataError(
                f"{self._name}: its pickle asks for {module}.{name}; only numpy arrays and plain "
                "values are read, and nothing is run. Do not use this file"
            )
        return found


class _Name:
    """Stands for what a pickle names. A pickle can call it, but not change it for the next."""

    def __init__(self, make: Callable[..., Any] | None = None) -> None:
        self._make = make

    def __call__(self, *arguments: Any) -> Any:
        if self._make is None:
            raise DataError("an array of the pickle is made in a way that numpy does not use")
        return self._make(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise DataError("the pickle gives a state to a name")


class _Type:
    """Stands for numpy.dtype: notes its code and byte order."""

    def __init__(self, *arguments: Any) -> None:
        code = arguments[0] if arguments else None
        code = code.decode("ascii", "replace") if isinstance(code, bytes) else code
        if not isinstance(code, str) or not _TYPE.fullmatch(code):
            raise DataError(f"arrays of type {str(code)[:40]!r} are not read, only numbers")
        self.code = code

    def __setstate__(self, state: Any) -> None:
        order = state[1]
        order = order.decode("ascii", "replace") if isinstance(order, bytes) else order
        if order not in ("<", ">", "|", "=") or any(state[2:5]):
            raise DataError("arrays with fields are not read, only numbers")
        self.code = order + self.code.lstrip("<>|=")

    def dtype(self) -> np.dtype:
        return np.dtype(self.code)


class _Array:
    """Stands for an array: notes shape, type and bytes."""

    def __init__(self) -> None:
        self.state: tuple | None = None

    def __setstate__(self, state: Any) -> None:
        self.state = tuple(state)


class _Scalar:
    """Stands for a numpy number."""

    def __init__(self, kind: _Type, content: bytes) -> None:
        self.kind, self.content = kind, content


def _array(*arguments: Any) -> _Array:
    return _Array()


def _bytes(text: str, encoding: str) -> bytes:
    """Protocol 2 writes bytes as a call of _codecs.encode with latin1."""
    if encoding not in ("latin1", b"latin1"):
        raise DataError(f"bytes are not encoded as {encoding!r}")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """Protocol 2 writes empty bytes as a call of the class without arguments."""
    return b""


_STAND_INS: dict[tuple[str, str], _Name] = {
    ("_codecs", "encode"): _Name(_bytes),
    ("__builtin__", "bytes"): _Name(_no_bytes),
    ("numpy", "ndarray"): _Name(),
    ("numpy", "dtype"): _Name(_Type),
    **{
        (module, name): _Name(what)
        for module in ("numpy.core.multiarray", "numpy._core.multiarray")
        for name, what in (("_reconstruct", _array), ("scalar", _Scalar))
    },
}


class _Builder:
    """Turns stand-ins into arrays, and counts: values may be shared, and shared again."""

    def __init__(self, name: str) -> None:
        self._name, self._left = name, _MAX_VALUES

    def build(self, value: Any, depth: int = 0) -> Any:
        self._left -= 1
        if self._left < 0 or depth > _MAX_DEPTH:
            raise DataError(f"{self._name} is nested too deeply, or holds too many values")
        if value is None or isinstance(value, bool | int | float | str | bytes):
            return value
        if isinstance(value, list | tuple):
            return type(value)(self.build(item, depth + 1) for item in value)
        if isinstance(value, dict):
            return {
                self.build(key, depth + 1): self.build(item, depth + 1)
                for key, item in value.items()
            }
        if isinstance(value, _Array):
            return self._array(value, depth)
        if isinstance(value, _Scalar):
            kind = value.kind.dtype() if isinstance(value.kind, _Type) else np.dtype(object)
            return self._numbers(value.content, kind, ())[()]
        raise DataError(f"{self._name}: a value of the pickle is neither plain nor an array")

    def _array(self, value: _Array, depth: int) -> np.ndarray:
        if value.state is None or len(value.state) != 5:
            raise DataError(f"{self._name}: an array of the pickle has no content")
        _, shape, kind, column_major, content = value.state
        if not isinstance(kind, _Type) or not isinstance(shape, tuple):
            raise DataError(f"{self._name}: an array of the pickle has no type or shape")
        if not all(type(side) is int and side >= 0 for side in shape) or len(shape) > 8:
            raise DataError(f"{self._name}: an array of the pickle has the shape {shape!r:.80}")
        dtype = kind.dtype()
        order: Literal["C", "F"] = "F" if column_major else "C"
        if not dtype.hasobject:
            return self._numbers(content, dtype, shape, order)
        if not isinstance(content, list) or len(content) != math.prod(shape):
            raise DataError(f"{self._name}: an array of the pickle is cut off")
        array = np.empty(len(content), dtype=object)
        for index, item in enumerate(content):
            array[index] = self.build(item, depth + 1)
        return array.reshape(shape, order=order)

    def _numbers(
        self,
        content: Any,
        dtype: np.dtype,
        shape: tuple[int, ...],
        order: Literal["C", "F"] = "C",
    ) -> np.ndarray:
        if dtype.hasobject or not isinstance(content, bytes):
            raise DataError(f"{self._name}: an array of the pickle holds no numbers")
        if len(content) != math.prod(shape) * dtype.itemsize:
            raise DataError(
                f"{self._name}: an array of shape {shape} has {len(content)} bytes: cut off"
            )
        return np.frombuffer(content, dtype=dtype).reshape(shape, order=order).copy()
