"""Untrusted tar files, read member by member in bounded memory and to their last byte."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import lzma
import tarfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from qs3.errors import DataError

DAMAGE = (
    *(EOFError, OSError, OverflowError, ValueError),
    *(lzma.LZMAError, tarfile.TarError, zlib.error),
)
"""What damaged ones raise."""

_MOST = 1 << 20  # bytes at once: more than this no header of a member has
_FARTHEST = 1 << 62  # bytes: no file is longer, and places in files have 63 bits
_PACKED = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ": lzma.open}


class _Pieces(io.RawIOBase):
    """A file of which nobody reads much at once: tarfile would, when a header says so."""

    def __init__(self, file: Any, path: Path) -> None:
        self._file, self._path = file, path

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= _MOST:
            raise DataError(f"{self._path}: a name of {size} bytes in the archive; refused")
        found: bytes = self._file.read(size)
        return found

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        if abs(offset) > _FARTHEST:
            raise DataError(f"{self._path}: a member that ends at {offset}; refused")
        return int(self._file.seek(offset, whence))

    def tell(self) -> int:
        return int(self._file.tell())


@contextlib.contextmanager
def open_tar(path: Path) -> Iterator[tarfile.TarFile]:
    """A .tar, .tar.gz, .tar.bz2 or .tar.xz, whatever its name, to go through with `members_of`.

    Raises:
        DataError: a header says that it is larger than any is.
        One of DAMAGE: damaged.
    """
    with open(path, "rb") as raw, contextlib.ExitStack() as stack:
        start = raw.read(8)
        raw.seek(0)
        unpack: Any = next((how for begin, how in _PACKED.items() if start.startswith(begin)), None)
        file: IO[bytes] = stack.enter_context(unpack(raw)) if unpack else raw
        with tarfile.open(fileobj=_Pieces(file, path), mode="r:") as archive:
            yield archive


def members_of(archive: tarfile.TarFile) -> Iterator[tarfile.TarInfo]:
    """The members, one in memory at a time; then the rest of the file.

    There, the checksum of what was packed is compared.
    """
    while (info := archive.next()) is not None:
        archive.members.clear()  # type: ignore[attr-defined]  # or millions pile up
        yield info
    file: Any = archive.fileobj
    while file.read(_MOST):
        pass


def is_whole(archive: tarfile.TarFile) -> bool:
    """Whether the archive, of which all members were read, ends as tar files do: by zeros."""
    file: Any = archive.fileobj
    file.seek(archive.offset)
    return len(file.read(tarfile.BLOCKSIZE)) == tarfile.BLOCKSIZE
