"""Archives of strangers, unpacked into a new folder and nowhere else.

Refused as a whole: names that are absolute or lead upwards, links, devices, encryption, two
members of one name, and archives that unpack to far more than they are (a "bomb"). Nothing is
taken over from the archive but names and contents: no owners, rights or dates.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import os
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any, NamedTuple

from qs3.errors import DataError, Qs3Error

_CHUNK = 1 << 20
_MAX_PADDING = 16 << 20  # zeros behind the last member of a tar
_MAGIC = (  # first bytes, at which place, kind
    (b"PK\x03\x04", 0, "zip"),
    (b"PK\x05\x06", 0, "zip"),
    (b"\x1f\x8b", 0, "tar"),
    (b"BZh", 0, "tar"),
    (b"\xfd7zXZ\x00", 0, "tar"),
    (b"ustar", 257, "tar"),
    (b"Rar!", 0, "rar"),
    (b"7z\xbc\xaf\x27\x1c", 0, "7z"),
)
_DAMAGE = (
    EOFError,
    OSError,
    RuntimeError,  # zipfile: a password is needed
    NotImplementedError,  # zipfile: another compression
    ValueError,
    gzip.BadGzipFile,
    lzma.LZMAError,
    tarfile.TarError,
    zipfile.BadZipFile,
    zlib.error,
)


@dataclass(frozen=True)
class Limits:
    """Above which an archive is no dataset.

    Attributes:
        members: files and folders.
        bytes: of all files.
        ratio: of what comes out to what goes in, from 64 MiB on; text compresses to a fourth or
            a tenth, a file of zeros to a thousandth.
    """

    members: int = 2_000_000
    bytes: int = 200 << 30
    ratio: float = 100.0


class _Member(NamedTuple):
    name: str
    is_folder: bool
    size: int
    problem: str
    open: Callable[[], IO[bytes] | None]


def kind_of(path: Path) -> str:
    """Tell "zip" from "tar" (packed or not) by the first bytes.

    Raises:
        DataError: another kind of file; says which, and what to do.
    """
    with open(path, "rb") as file:
        head = file.read(512)
    kind = next((k for magic, at, k in _MAGIC if head[at : at + len(magic)] == magic), None)
    if kind in ("rar", "7z"):
        raise DataError(
            f"{path} is a {kind} archive, which is not unpacked here: unpack it with your own "
            "program, put the files into a .zip or .tar, and give that one with archive=PATH"
        )
    if kind is None:
        text = head.lstrip()[:15].lower()
        page = " but a web page" if text.startswith((b"<!doctype html", b"<html")) else ""
        raise DataError(f"{path} is no zip and no tar archive{page}; delete it and try again")
    return kind


def unpack(
    archive: Path,
    into: Path,
    limits: Limits | None = None,
    report: Callable[[int, int | None], None] = lambda done, total: None,
) -> int:
    """Unpack into the new folder `into`.

    Mac OS's companions (`__MACOSX`, `._name`, `.DS_Store`) are left out.

    Args:
        archive: .zip, .tar, .tar.gz, .tar.bz2 or .tar.xz, recognised by its first bytes.
        into: must not exist; after an error it holds a part, which the caller deletes.
        limits: see `Limits`.
        report: told how many bytes are written, and of how many if that is known.

    Returns:
        How many files there are.

    Raises:
        DataError: damaged, or not to be trusted; names the member.
        Qs3Error: the disk is full or not writable.
    """
    limits = limits or Limits()
    into.mkdir(parents=True)
    most = min(limits.bytes, int(max(64 << 20, limits.ratio * archive.stat().st_size)))
    written = files = 0
    seen: set[str] = set()
    reader = _zip_members if kind_of(archive) == "zip" else _tar_members
    with _named(archive), reader(archive) as (total, members):
        for number, member in enumerate(members):
            if number >= limits.members:
                raise DataError(f"{archive} has more than {limits.members} members; refused")
            where = f"{archive}, member {member.name!r}"
            path = safe_path(member.name, where)
            if path is None or member.is_folder:
                continue  # folders come with their files
            if member.problem:
                raise DataError(f"{where}: {member.problem}; refused")
            if str(path) in seen:
                raise DataError(f"{where}: a second file of this name; refused")
            seen.add(str(path))
            if written + member.size > most:
                raise DataError(
                    f"{where}: the archive unpacks to more than {most / 1e9:.2f} GB "
                    f"({limits.ratio:.0f} times its size); refused"
                )
            written = _write(member, into / path, written, most, where, report, total)
            files += 1
    return files


def safe_path(name: str, where: str) -> PurePosixPath | None:
    """A member's path below the folder that is unpacked into; None for Mac OS's companions.

    Raises:
        DataError: it could lead out of that folder, on this system or another.
    """
    if any(ord(sign) < 32 or ord(sign) == 127 for sign in name) or "\\" in name:
        raise DataError(f"{where}: a name with control characters or backslashes; refused")
    try:
        name.encode()
    except UnicodeEncodeError as error:
        raise DataError(f"{where}: the name is not UTF-8; refused") from error
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or ":" in name.partition("/")[0]:
        raise DataError(f"{where}: the name leads out of the folder; refused")
    if not path.parts or "__MACOSX" in path.parts:
        return None
    if path.name == ".DS_Store" or path.name.startswith("._"):
        return None
    if len(name.encode()) > 1024 or any(len(part.encode()) > 255 for part in path.parts):
        raise DataError(f"{where}: the name is too long; refused")
    return path


def _write(
    member: _Member,
    path: Path,
    written: int,
    most: int,
    where: str,
    report: Callable[[int, int | None], None],
    total: int | None,
) -> int:
    """Copy one file; returns the bytes written so far, of all files."""
    start = written
    source = member.open()
    if source is None:
        raise DataError(f"{where}: has no content; refused")
    with source:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = open(path, "xb")  # noqa: SIM115 (closed below)
        except (FileExistsError, NotADirectoryError) as error:
            raise DataError(f"{where}: the same name is also that of a folder or file") from error
        except OSError as error:
            raise Qs3Error(f"cannot write {path}: {error.strerror}; free some space") from error
        with file:
            while chunk := source.read(_CHUNK):
                written += len(chunk)
                if written > most:  # sizes in headers may lie
                    raise DataError(f"{where}: unpacks to more than its header says; refused")
                try:
                    file.write(chunk)
                except OSError as error:
                    raise Qs3Error(f"cannot write {path}: {error.strerror}") from error
                report(written, total)
    if written - start != member.size:
        raise DataError(f"{where}: {written - start} bytes instead of {member.size}: damaged")
    return written


@contextmanager
def _named(archive: Path) -> Iterator[None]:
    """What the archive's reader stumbles over, as an error that names the archive."""
    try:
        yield
    except Qs3Error:
        raise
    except _DAMAGE as error:
        raise DataError(
            f"{archive} is damaged ({type(error).__name__}: {error}); delete it and try again"
        ) from error


@contextmanager
def _zip_members(archive: Path) -> Iterator[tuple[int | None, Iterator[_Member]]]:
    with zipfile.ZipFile(archive) as file:
        infos = file.infolist()

        def members() -> Iterator[_Member]:
            for info in infos:
                mode = info.external_attr >> 16
                odd = stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR)
                problem = "a link or a device" if odd else ""
                if info.flag_bits & 1:
                    problem = "encrypted"
                # orig_filename: ZipInfo cuts names at a NUL and turns the system's separators
                yield _Member(
                    info.orig_filename,
                    info.is_dir() and not odd,
                    info.file_size,
                    problem,
                    lambda info=info: file.open(info),  # type: ignore[misc]
                )

        yield sum(info.file_size for info in infos), members()


@contextmanager
def _tar_members(archive: Path) -> Iterator[tuple[int | None, Iterator[_Member]]]:
    with _decompressed(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as file:

        def members() -> Iterator[_Member]:
            while (info := file.next()) is not None:
                file.members.clear()  # type: ignore[attr-defined]  # or millions pile up
                plain = info.isreg() and not info.issparse()
                problem = "" if plain or info.isdir() else "a link, a device or a sparse file"
                yield _Member(
                    info.name,
                    info.isdir(),
                    info.size,
                    problem,
                    lambda info=info: file.extractfile(info),  # type: ignore[misc]
                )
            _check_end(stream, file.offset)

        yield None, members()


def _decompressed(archive: Path) -> IO[bytes]:
    """The tar's bytes; buffered, since a packed stream goes back only by starting over."""
    with open(archive, "rb") as file:
        head = file.read(6)
    stream: Any = None
    for magic, opener in ((b"\x1f\x8b", gzip.open), (b"BZh", bz2.open), (b"\xfd7zXZ", lzma.open)):
        if head.startswith(magic):
            stream = opener(archive, "rb")
    return io.BufferedReader(stream or open(archive, "rb", buffering=0), _CHUNK)


def _check_end(stream: IO[bytes], offset: int) -> None:
    """After the last member: a block of zeros, then the compressed stream's own checksum.

    `tarfile` takes a broken header behind the first member for the end, and never reads the
    stream to where its checksum is.
    """
    stream.seek(offset)
    if stream.read(512) != bytes(512):
        raise tarfile.ReadError(f"no header of a member and no end at byte {offset}")
    rest = 0
    while chunk := stream.read(_CHUNK):
        rest += len(chunk)
        if rest > _MAX_PADDING:
            raise tarfile.ReadError("goes on behind its end")


def delete(folder: Path) -> None:
    """Remove a folder that `unpack` made, if it is there."""
    import shutil

    if os.path.lexists(folder):
        shutil.rmtree(folder)
