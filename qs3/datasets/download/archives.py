"""Untrusted archives: unpacked into one new folder, and the wanted folder found in them.

Refused as a whole: names that lead out of the folder, links, devices, encryption, and archives that
unpack to far more than they are (a "bomb"). Nothing is taken over but names and contents: no
owners, rights or dates.
"""

from __future__ import annotations

import re
import shutil
import stat
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import IO, NamedTuple

from qs3.errors import DataError, Qs3Error
from qs3.utils.plural import counted
from qs3.utils.progress import shown
from qs3.utils.tars import DAMAGE, members_of, open_tar

MAX_MEMBERS = 2_000_000
MAX_BYTES = 200 << 30
MAX_RATIO = 100  # of what comes out to what goes in, from 64 MiB on: text packs to a tenth

# RuntimeError: zipfile wants a password; NotImplementedError: another compression; LookupError: a
# name that begins with NUL.
_DAMAGE = (*DAMAGE, RuntimeError, NotImplementedError, LookupError, zipfile.BadZipFile)


class _Member(NamedTuple):
    name: str
    size: int
    plain: bool
    open: Callable[[], IO[bytes] | None]


def unpack(archive: Path, into: Path) -> list[str]:
    """Unpack a .zip, .tar, .tar.gz, .tar.bz2 or .tar.xz, whatever its name, into a new folder.

    Mac OS's companions (`__MACOSX`, `._name`) are left out. After an error `into` holds a part,
    which the caller deletes.

    Returns:
        The files, relative to `into`, with slashes.

    Raises:
        DataError: damaged, or not to be trusted; names the member.
        Qs3Error: the disk is full or not writable.
    """
    most = min(MAX_BYTES, max(64 << 20, MAX_RATIO * archive.stat().st_size))
    files, total = [], 0
    members = _zip_members if zipfile.is_zipfile(archive) else _tar_members
    try:
        into.mkdir(parents=True)
        for count, member in enumerate(shown(members(archive), archive.name)):
            where = f"{archive}, member {member.name!r}"
            path = _safe_path(member.name, where)
            if not member.plain:
                raise DataError(f"{where}: a link, a device or a sparse file; refused")
            total += member.size
            if total > most or count >= MAX_MEMBERS:
                raise DataError(
                    f"{where}: the archive unpacks to more than {most / 1e9:.2f} GB or "
                    f"{MAX_MEMBERS} files; refused"
                )
            if "__MACOSX" in path.parts or path.name.startswith("._"):
                continue
            source = member.open()
            assert source is not None  # a regular file
            (into / path).parent.mkdir(parents=True, exist_ok=True)
            with source, open(into / path, "xb") as file:
                shutil.copyfileobj(source, file, 1 << 20)
            files.append(str(path))
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
        raise DataError(f"{archive}: two members have the name {error.filename}") from error
    except _DAMAGE as error:
        if getattr(error, "errno", None):  # the packers' own errors, also OSError, have none
            raise Qs3Error(f"cannot unpack {archive}: {error}; free some space") from error
        why = str(error).partition("\n")[0].rstrip(":")
        raise DataError(
            f"{archive} is damaged, or is not a .zip or .tar file ({type(error).__name__}: {why}). "
            "Delete it and fetch it again; files in another format you can unpack yourself, pack "
            "as .zip, and give with archive=PATH"
        ) from error
    return files


def _safe_path(name: str, where: str) -> PurePosixPath:
    """A member's path; DataError if it could lead out of the folder, on this system or another."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or re.search(r"[\x00-\x1f\x7f\\]|^[^/]*:", name):
        raise DataError(f"{where}: the name leads out of the folder, or has odd signs; refused")
    return path


def _zip_members(archive: Path) -> Iterator[_Member]:
    with zipfile.ZipFile(archive) as file:
        for info in file.infolist():
            plain = stat.S_IFMT(info.external_attr >> 16) in (0, stat.S_IFREG, stat.S_IFDIR)
            if info.is_dir() and plain:
                continue
            # orig_filename: ZipInfo cuts names at a NUL. What is read is never more than file_size.
            yield _Member(info.orig_filename, info.file_size, plain, lambda i=info: file.open(i))  # type: ignore[misc]


def _tar_members(archive: Path) -> Iterator[_Member]:
    with open_tar(archive) as file:
        for info in members_of(file):
            if info.isdir():
                continue
            plain = info.isreg() and not info.issparse()
            yield _Member(info.name, info.size, plain, lambda i=info: file.extractfile(i))  # type: ignore[misc]


def find_folder(files: Iterable[str], holds: str, named: str = "", at_least: int = 10) -> str:
    """The folder of an unpacked archive that an importer reads: nobody promises how it is nested.

    For `holds`, `named` and `at_least` see `Part`. `files` and the result are relative to the
    archive's top, with slashes; "" is the top itself.

    Raises:
        DataError: there is none, or there are several.
    """
    name = rf"(?:.*/)?(?i:{named})/" if named else r"(?:.*/)?"
    pattern = re.compile(rf"(?P<root>{name}){holds}")
    roots = Counter(found["root"] for file in files if (found := pattern.fullmatch(file)))
    large = sorted(root for root, count in roots.items() if count >= at_least)
    if len(large) > 1:
        raise DataError(f"several folders could be meant, {', '.join(large[:8])}: give root=FOLDER")
    if not large:
        raise DataError("no folder with the wanted files")
    return large[0].rstrip("/")


def outline(files: Iterable[str], most: int = 12) -> str:
    """What an archive holds, for a message: folders down to the third level, with counts."""
    counts = Counter("/".join(file.split("/")[:-1][:3]) or "." for file in files)
    lines = [f"  {folder}: {counted(count, 'file')}" for folder, count in sorted(counts.items())]
    more = [f"  ... and {counted(len(lines) - most, 'folder')} more"] if len(lines) > most else []
    return "\n".join([*lines[:most], *more])
