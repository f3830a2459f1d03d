"""PCD, the Point Cloud Library's format, version 0.7: text, binary and compressed.

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

_MAX_HEADER_BYTES = 1 << 16
_MAX_FIELDS = 256
_MAX_COUNT = 1 << 16  # values of one field a point; the longest descriptors of PCL have 1980
_MAX_BYTES = 1 << 31  # of a file, and of what it expands to
_MAX_WORD_BYTES = 64  # of one number in a text file
# A back reference of three bytes stands for at most 264 bytes.
_MAX_EXPANSION = 88
_KINDS = {"I": "i", "U": "u", "F": "f"}
_SIZES = {"I": (1, 2, 4, 8), "U": (1, 2, 4, 8), "F": (4, 8)}
_KEYS = (
    *("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS"),
    *("COLUMNS",),  # what 0.5 called FIELDS
)


@dataclass(frozen=True, eq=False)
class PcdCloud:
    """A cloud as the file has it.

    Attributes:
        fields: name -> [N] in the file's type and unit, [N, count] where a field has several
            values; N = width * height, row-major. No measurement is NaN in x, y and z.
        width, height: of the depth image in an organised cloud; height is 1 in any other.
        viewpoint: tx ty tz qw qx qy qz of the sensor, as stated.
    """

    fields: Mapping[str, np.ndarray]
    width: int
    height: int
    viewpoint: tuple[float, float, float, float, float, float, float] = (0, 0, 0, 1, 0, 0, 0)

    @property
    def organised(self) -> bool:
        """Whether the points are the pixels of an image."""
        return self.height > 1

    def xyz(self) -> np.ndarray:
        """[N, 3] float64 in the file's unit (metres by convention), with NaN.

        Raises:
            DataError: x, y or z is missing.
        """
        missing = [axis for axis in "xyz" if axis not in self.fields]
        if missing:
            raise DataError(f"a cloud without {', '.join(missing)} has no positions")
        return np.stack([self.fields[axis] for axis in "xyz"], axis=1).astype(np.float64)

    def image(self, name: str) -> np.ndarray:
        """[height, width] of one field of an organised cloud.

        Raises:
            DataError: the cloud is not an image, or has no such field.
        """
        if not self.organised:
            raise DataError(f"a cloud of {self.width} x 1 points is not an image")
        if name not in self.fields:
            raise DataError(f"a cloud with the fields {', '.join(self.fields)} has no {name}")
        return self.fields[name].reshape(self.height, self.width, *self.fields[name].shape[1:])

    def colours(self) -> np.ndarray | None:
        """[N, 3] uint8 red, green, blue of the packed field rgb or rgba; None without one."""
        packed = self.fields.get("rgba", self.fields.get("rgb"))
        if packed is None or packed.itemsize != 4 or packed.ndim != 1:
            return None
        bits = np.ascontiguousarray(packed).view(np.uint32)  # rgb is often stored as a float
        return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)


@dataclass(frozen=True)
class _Header:
    names: tuple[str, ...]
    dtypes: tuple[np.dtype, ...]
    counts: tuple[int, ...]
    width: int
    height: int
    viewpoint: tuple[float, ...]
    data: str

    @property
    def points(self) -> int:
        return self.width * self.height

    @property
    def values(self) -> int:
        """Numbers a point."""
        return sum(self.counts)

    @property
    def point_bytes(self) -> int:
        return sum(d.itemsize * c for d, c in zip(self.dtypes, self.counts, strict=True))


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
        size = path.stat().st_size
        if size > _MAX_BYTES:
            raise DataError(f"{path} has {size} bytes, more than the {_MAX_BYTES} that are read")
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
    if total > _MAX_BYTES:
        raise DataError(f"promises {total} bytes of points, more than the {_MAX_BYTES} allowed")
    body = memoryview(data)[start:]
    if header.data == "ascii":
        columns = _text_columns(header, bytes(body))
    elif header.data == "binary":
        columns = _row_columns(header, body)
    else:
        columns = _block_columns(header, _decompressed(header, body))
    # Padding is called "_" and may occur several times.
    fields = {n: c for n, c in zip(header.names, columns, strict=True) if n != "_"}
    viewpoint = header.viewpoint
    return PcdCloud(fields, header.width, header.height, viewpoint)  # type: ignore[arg-type]


def _parse_header(data: bytes) -> tuple[_Header, int]:
    """The header, and where the data begin."""
    entries: dict[str, list[str]] = {}
    offset = 0
    while True:
        end = data.find(b"\n", offset, _MAX_HEADER_BYTES)
        if end < 0:
            raise DataError("is not a PCD file, or cut within its header: it has no line DATA")
        line = data[offset:end].decode("latin-1").strip()
        offset = end + 1
        if not line or line.startswith("#"):
            continue
        key, *words = line.split()
        if key == "DATA":
            break
        if key not in _KEYS:
            raise DataError(f"has a header line that PCD does not know: {line[:60]!r}")
        if key in entries:
            raise DataError(f"has two header lines {key}")
        entries[key] = words
    if words not in (["ascii"], ["binary"], ["binary_compressed"]):
        raise DataError(
            f"has DATA {' '.join(words)[:40]!r}; ascii, binary, binary_compressed exist"
        )
    version = " ".join(entries.get("VERSION", ["0.7"]))
    if version not in ("0.7", ".7"):
        raise DataError(f"is of PCD version {version[:20]!r}; only 0.7 is read")
    return _checked(entries, words[0]), offset


def _checked(entries: dict[str, list[str]], data: str) -> _Header:
    names = entries.get("FIELDS", [])
    if not 0 < len(names) <= _MAX_FIELDS:
        raise DataError(f"has {len(names)} fields; 1 to {_MAX_FIELDS} are possible")
    twice = sorted({n for n in names if n != "_" and names.count(n) > 1})
    if twice:
        raise DataError(f"has two fields called {twice[0]!r}")
    sizes = _whole(entries, "SIZE", len(names))
    kinds = entries.get("TYPE", [])
    if len(kinds) != len(names):
        raise DataError(f"has {len(kinds)} values in TYPE for {len(names)} fields")
    counts = _whole(entries, "COUNT", len(names)) if "COUNT" in entries else [1] * len(names)
    for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True):
        if size not in _SIZES.get(kind, ()):
            raise DataError(f"has a field {name!r} of the unknown type {kind!r} with {size} bytes")
        if not 0 < count <= _MAX_COUNT:
            raise DataError(f"has a field {name!r} with a COUNT of {count}")
    (width,) = _whole(entries, "WIDTH", 1)
    (height,) = _whole(entries, "HEIGHT", 1)
    points = _whole(entries, "POINTS", 1)[0] if "POINTS" in entries else width * height
    if points != width * height:
        raise DataError(f"promises {points} POINTS, but {width} x {height}")
    view = entries.get("VIEWPOINT", ["0", "0", "0", "1", "0", "0", "0"])
    try:
        viewpoint = tuple(float(word) for word in view)
    except ValueError:
        viewpoint = ()
    if len(viewpoint) != 7:
        raise DataError(f"has a VIEWPOINT that is not seven numbers: {' '.join(view)[:60]!r}")
    dtypes = tuple(np.dtype(f"<{_KINDS[k]}{s}") for k, s in zip(kinds, sizes, strict=True))
    return _Header(tuple(names), dtypes, tuple(counts), width, height, viewpoint, data)


def _whole(entries: dict[str, list[str]], key: str, count: int) -> list[int]:
    words = entries.get(key, [])
    if len(words) != count:
        raise DataError(f"has {len(words)} values in {key}, not {count}")
    if not all(w.isascii() and w.isdigit() and len(w) <= 10 for w in words):
        raise DataError(f"has a {key} that is not whole numbers: {' '.join(words)[:60]!r}")
    return [int(word) for word in words]


def _text_columns(header: _Header, body: bytes) -> list[np.ndarray]:
    wanted = header.points * header.values
    if wanted > (len(body) + 1) // 2:  # a digit and a space each
        raise DataError(f"is cut: {wanted} numbers do not fit into {len(body)} bytes of text")
    words = body.split()
    if len(words) != wanted:
        raise DataError(f"has {len(words)} numbers where its header promises {wanted}")
    if max(map(len, words), default=0) > _MAX_WORD_BYTES:
        raise DataError("has a number of more than 64 characters")
    columns, first = [], 0
    for name, dtype, count in zip(header.names, header.dtypes, header.counts, strict=True):
        parts = [_numbers(name, words[first + i :: header.values], dtype) for i in range(count)]
        columns.append(parts[0] if count == 1 else np.stack(parts, axis=1))
        first += count
    return columns


def _numbers(name: str, words: list[bytes], dtype: np.dtype) -> np.ndarray:
    if not words:
        return np.zeros(0, dtype)
    try:
        if dtype.kind == "f":
            with np.errstate(over="ignore"):
                return np.array(words).astype(np.float64).astype(dtype)
        wide = np.array(words).astype(np.uint64 if dtype == np.uint64 else np.int64)
    except (ValueError, OverflowError) as error:
        raise DataError(f"has something else than a number in the field {name!r}") from error
    limits = np.iinfo(dtype)
    if wide.min() < limits.min or wide.max() > limits.max:
        raise DataError(f"has a number in the field {name!r} that {dtype.name} does not hold")
    return wide.astype(dtype)


def _row_columns(header: _Header, body: memoryview) -> list[np.ndarray]:
    """Point after point."""
    needed = header.points * header.point_bytes
    if len(body) < needed:
        raise DataError(f"is cut: it has {len(body)} of the {needed} bytes of its points")
    row = np.dtype(
        [
            (f"f{i}", dtype, (count,)) if count > 1 else (f"f{i}", dtype)
            for i, (dtype, count) in enumerate(zip(header.dtypes, header.counts, strict=True))
        ]
    )
    table = np.frombuffer(body, row, header.points)
    return [np.ascontiguousarray(table[f"f{i}"]) for i in range(len(header.names))]


def _block_columns(header: _Header, body: bytes) -> list[np.ndarray]:
    """Field after field, as in compressed files."""
    columns, offset = [], 0
    for dtype, count in zip(header.dtypes, header.counts, strict=True):
        column = np.frombuffer(body, dtype, header.points * count, offset)
        offset += column.nbytes
        columns.append((column if count == 1 else column.reshape(-1, count)).copy())
    return columns


def _decompressed(header: _Header, body: memoryview) -> bytes:
    needed = header.points * header.point_bytes
    if len(body) < 8:
        raise DataError("is cut: it has no sizes before its compressed data")
    packed, full = (int(n) for n in np.frombuffer(body[:8], "<u4"))
    if full != needed:
        raise DataError(f"states {full} bytes when decompressed; its points have {needed}")
    if packed > len(body) - 8:
        raise DataError(f"is cut: it has {len(body) - 8} of {packed} compressed bytes")
    if full > packed * _MAX_EXPANSION:
        raise DataError(f"claims that {packed} bytes decompress to {full}, more than LZF can")
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
