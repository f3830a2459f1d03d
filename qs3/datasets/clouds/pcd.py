"""x, y and z of PCD, the Point Cloud Library's format, version 0.7: text, binary, compressed.

Written after the format's public description (PCL documentation, "The PCD file format") and that
of LZF, the compression that it uses (M. Lehmann, liblzf). Files are not trusted: every size is
checked against the file before memory is taken for it, and nothing in a file is ever executed.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.errors import DataError, MissingDataError
from qs3.utils.memory import check_memory
from qs3.utils.plural import counted

_MAX_HEADER_BYTES = 1 << 16
_MAX_WORD_BYTES = 64  # of one number in a text file
# A back reference of three bytes stands for at most 264 bytes.
_MAX_EXPANSION = 88
_AXES = ("x", "y", "z")
_KINDS = {"I": "i", "U": "u", "F": "f"}
_SIZES = {"I": (1, 2, 4, 8), "U": (1, 2, 4, 8), "F": (4, 8)}
_KEYS = (
    *("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS"),
    *("COLUMNS",),  # what 0.5 called FIELDS
)


@dataclass(frozen=True, eq=False)
class PcdCloud:
    """Positions as the file has them.

    Attributes:
        fields: "x", "y", "z" and "label", as far as the file has them: [N] in its type and unit,
            N = width * height, row-major. No measurement is NaN.
        width, height: of the depth image in an organised cloud; height is 1 in any other.
    """

    fields: Mapping[str, np.ndarray]
    width: int
    height: int

    def xyz(self) -> np.ndarray:
        """[N, 3] float64 in the file's unit (metres by convention), with NaN.

        Raises:
            DataError: x, y or z is missing.
        """
        missing = [axis for axis in _AXES if axis not in self.fields]
        if missing:
            raise DataError(f"a cloud without {', '.join(missing)} has no positions")
        return np.stack([self.fields[axis] for axis in _AXES], axis=1).astype(np.float64)

    def image(self, name: str) -> np.ndarray:
        """[height, width] one field of an organised cloud.

        Raises:
            DataError: the cloud is not an image, or has no such field.
        """
        if self.height <= 1:
            raise DataError(f"a cloud of {self.width} x 1 points is not an image")
        if name not in self.fields:
            raise DataError(f"a cloud with the fields {', '.join(self.fields)} has no {name}")
        return self.fields[name].reshape(self.height, self.width)


@dataclass(frozen=True)
class _Field:
    """A field with `numbers` numbers and `offset` bytes of a point before it."""

    name: str
    dtype: np.dtype
    numbers: int
    offset: int


@dataclass(frozen=True)
class _Header:
    """`fields` are those that are read; a point has `numbers` numbers in `point_bytes` bytes."""

    fields: tuple[_Field, ...]
    numbers: int
    point_bytes: int
    width: int
    height: int
    data: str

    @property
    def points(self) -> int:
        return self.width * self.height


def read_pcd(path: str | os.PathLike[str]) -> PcdCloud:
    """Read a PCD file: DATA ascii, binary or binary_compressed.

    Raises:
        MissingDataError: there is no such file.
        DataError: it is not a PCD file, damaged, or beyond the limits of this reader.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise MissingDataError(f"{path}: there is no such file")
        check_memory(2 * path.stat().st_size, path)
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from error
    try:
        return parse_pcd(data)
    except DataError as error:
        raise DataError(f"{path} {error}") from error


def parse_pcd(data: bytes) -> PcdCloud:
    """The content of a PCD file.

    Raises:
        DataError: as `read_pcd`; the message lacks the file's name.
    """
    header, start = _parse_header(data)
    total = header.points * header.point_bytes
    body = memoryview(data)[start:]
    if header.data == "ascii":
        fields = _from_text(header, bytes(body))
    elif header.data == "binary":
        fields = _from_rows(header, body, total)
    else:
        fields = _from_blocks(header, _decompressed(body, total))
    return PcdCloud(fields, header.width, header.height)


def _parse_header(data: bytes) -> tuple[_Header, int]:
    """The header, and where the data begin."""
    entries: dict[str, list[str]] = {}
    offset = 0
    while "DATA" not in entries:
        end = data.find(b"\n", offset, _MAX_HEADER_BYTES)
        if end < 0:
            raise DataError("is not a PCD file, or cut within its header: it has no line DATA")
        line = data[offset:end].decode("latin-1").strip()
        offset = end + 1
        if not line or line.startswith("#"):
            continue
        key, *words = line.split()
        if key not in (*_KEYS, "DATA"):
            raise DataError(f"has a header line that PCD does not know: {line[:60]!r}")
        if key in entries:
            raise DataError(f"has two header lines {key}")
        entries[key] = words
    data_kind = " ".join(entries["DATA"])
    if data_kind not in ("ascii", "binary", "binary_compressed"):
        raise DataError(f"has DATA {data_kind[:40]!r}; ascii, binary, binary_compressed exist")
    version = " ".join(entries.get("VERSION", ["0.7"]))
    if version not in ("0.7", ".7"):
        raise DataError(f"is of PCD version {version[:20]!r}; only 0.7 is read")
    (width,), (height,) = _whole(entries, "WIDTH", 1), _whole(entries, "HEIGHT", 1)
    points = _whole(entries, "POINTS", 1)[0] if "POINTS" in entries else width * height
    if points != width * height:
        raise DataError(f"promises {points} POINTS, but {width} x {height}")
    return _Header(*_fields(entries), width, height, data_kind), offset


def _fields(entries: dict[str, list[str]]) -> tuple[tuple[_Field, ...], int, int]:
    """The fields that are read; numbers and bytes of a point."""
    names, kinds = entries.get("FIELDS", []), entries.get("TYPE", [])
    if not names:
        raise DataError("has no fields")
    if len(kinds) != len(names):
        raise DataError(
            f"has {counted(len(kinds), 'value')} in TYPE for {counted(len(names), 'field')}"
        )
    sizes = _whole(entries, "SIZE", len(names))
    counts = _whole(entries, "COUNT", len(names)) if "COUNT" in entries else [1] * len(names)
    fields: dict[str, _Field] = {}
    numbers = offset = 0
    for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True):
        if size not in _SIZES.get(kind, ()):
            raise DataError(f"has a field {name!r} of the unknown type {kind!r} with {size} bytes")
        if count < 1 or (name in _AXES and count > 1):
            raise DataError(f"has a field {name!r} with a COUNT of {count}")
        if name in fields:
            raise DataError(f"has two fields called {name!r}")
        if name in _AXES or (name == "label" and count == 1):
            fields[name] = _Field(name, np.dtype(f"<{_KINDS[kind]}{size}"), numbers, offset)
        numbers, offset = numbers + count, offset + count * size
    return tuple(fields.values()), numbers, offset


def _whole(entries: dict[str, list[str]], key: str, count: int) -> list[int]:
    words = entries.get(key, [])
    if len(words) != count:
        raise DataError(f"has {counted(len(words), 'value')} in {key}, not {count}")
    if not all(w.isascii() and w.isdigit() and len(w) <= 10 for w in words):
        raise DataError(f"has a {key} that is not whole numbers: {' '.join(words)[:60]!r}")
    return [int(word) for word in words]


def _from_text(header: _Header, body: bytes) -> dict[str, np.ndarray]:
    wanted = header.points * header.numbers
    if wanted > (len(body) + 1) // 2:  # a digit and a space each
        raise DataError(f"is cut: {wanted} numbers do not fit into {len(body)} bytes of text")
    # A word is an object of 40 bytes; those of a field become rows as long as the longest.
    check_memory(48 * wanted + (_MAX_WORD_BYTES + 16) * header.points, "")
    words = body.split()
    if len(words) != wanted:
        raise DataError(f"has {counted(len(words), 'number')} where its header promises {wanted}")
    if max(map(len, words), default=0) > _MAX_WORD_BYTES:
        raise DataError(f"has a number of more than {_MAX_WORD_BYTES} characters")
    return {f.name: _numbers(f, words[f.numbers :: header.numbers]) for f in header.fields}


def _numbers(field: _Field, words: list[bytes]) -> np.ndarray:
    try:
        wide = np.array(words, dtype=np.bytes_).astype(np.float64)
    except ValueError as error:
        raise DataError(f"has something else than a number in the field {field.name!r}") from error
    with np.errstate(over="ignore", invalid="ignore"):
        column = wide.astype(field.dtype)
    if field.dtype.kind != "f" and (column != wide).any():
        raise DataError(
            f"has a number in the field {field.name!r} that {field.dtype.name} does not hold"
        )
    return column


def _from_rows(header: _Header, body: memoryview, needed: int) -> dict[str, np.ndarray]:
    """Point after point."""
    if len(body) < needed:
        raise DataError(f"is cut: it has {len(body)} of the {needed} bytes of its points")
    row = np.dtype(
        {
            "names": [field.name for field in header.fields],
            "formats": [field.dtype for field in header.fields],
            "offsets": [field.offset for field in header.fields],
            "itemsize": header.point_bytes,
        }
    )
    table = np.frombuffer(body, row, header.points)
    return {field.name: table[field.name].copy() for field in header.fields}


def _from_blocks(header: _Header, body: bytes) -> dict[str, np.ndarray]:
    """Field after field, as in compressed files."""
    n = header.points
    return {f.name: np.frombuffer(body, f.dtype, n, n * f.offset).copy() for f in header.fields}


def _decompressed(body: memoryview, needed: int) -> bytes:
    if len(body) < 8:
        raise DataError("is cut: it has no sizes before its compressed data")
    packed, full = (int(n) for n in np.frombuffer(body[:8], "<u4"))
    if full != needed:
        raise DataError(f"states {full} bytes when decompressed; its points have {needed}")
    if packed > len(body) - 8:
        raise DataError(f"is cut: it has {len(body) - 8} of {packed} compressed bytes")
    if full > packed * _MAX_EXPANSION:
        raise DataError(f"claims that {packed} bytes decompress to {full}, more than LZF can")
    check_memory(3 * full, "")  # unpacked, joined, by field
    return lzf_decompress(bytes(body[8 : 8 + packed]), full)


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Expand LZF.

    A control byte below 32 is followed by one byte more than it says, to be copied. Any other is
    a back reference: its upper three bits are the length less 2 (7: add the next byte), the
    lower five and the next byte the distance less 1.

    Args:
        data: compressed.
        size: of the result.

    Raises:
        DataError: damaged, or the result has another size.
    """
    out = bytearray()
    position, end = 0, len(data)
    try:
        while position < end:
            control = data[position]
            position += 1
            if control < 32:
                out += data[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[position]
                position += 1
            length += 2
            distance = ((control & 31) << 8) + data[position] + 1
            position += 1
            start = len(out) - distance
            if start < 0:
                raise DataError("has damaged compressed data: they refer to before their beginning")
            if distance >= length:
                out += out[start : start + length]
            else:  # the copy overlaps itself: a pattern that repeats
                pattern = bytes(out[start:])
                out += (pattern * (length // distance + 1))[:length]
            if len(out) > size:
                break
    except IndexError:
        raise DataError("has damaged compressed data: they are cut") from None
    if position > end or len(out) != size:
        raise DataError(f"has damaged compressed data: {len(out)} bytes came out of {size}")
    return bytes(out)
