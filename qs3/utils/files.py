"""Writing files so that a crash never leaves half of one: used by everything that saves.

The one idea: write a temporary file in the same folder, flush it to the disk, then rename it over
the final name. A reader sees the old file or the new one, never a mixture. A kill leaves at most
a temporary file, which `remove_leftovers` clears. Locks between processes are gone when the process
ends.
"""

import contextlib
import fcntl
import hashlib
import json
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from qs3.errors import DataError, MissingDataError, Qs3Error

_LOCK = ".lock"


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path in the folder of `path`; rename it to `path` if the block succeeds.

    It has the same extension (some writers choose the format by it). If the block raises, the
    temporary file is removed and `path` stays as it was; an OSError becomes a Qs3Error.
    """
    path = Path(path)
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp{path.suffix}")
        temporary.touch(exist_ok=False)
        yield temporary
        _flush(temporary)
        os.replace(temporary, path)
        temporary = None
        _flush(path.parent)
    except OSError as error:
        raise Qs3Error(f"cannot write {path}: {error}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def reading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn whatever the block raises on a damaged file into a DataError that names it."""
    try:
        yield
    except FileNotFoundError as error:
        raise MissingDataError(f"there is no {path}") from error
    except Exception as error:  # what damaged bytes do to a reader cannot be listed
        if isinstance(error, Qs3Error) and str(path) in str(error):
            raise
        why = " ".join(str(error).split())[:300] or type(error).__name__
        raise DataError(f"{path} cannot be read: {why}") from error


def make_folder(path: str | os.PathLike[str]) -> Path:
    """Make a folder and its parents; Qs3Error if it cannot be made or written to."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):  # permissions do not tell, root's and read-only
            pass
    except OSError as error:
        raise Qs3Error(f"cannot write in {path}: {error}") from error
    return Path(path)


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Replace the file `path` by `data`, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    r"""Replace the file `path` by `text` (UTF-8, `\n` kept as it is), atomically."""
    write_bytes(path, text.encode())


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Replace `path` by `value` as indented JSON; NaN and infinity are refused (ValueError)."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def sha256_file(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's bytes as 64 hex digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_leftovers(folder: str | os.PathLike[str]) -> None:
    """Delete temporary files that a killed process left directly in `folder`.

    Only where no other process writes: under `locked`, or in one's own run folder.
    """
    for path in Path(folder).glob(".*.*.tmp*"):
        if path.is_file():
            path.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Force a file's bytes, or a folder's list of names, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def copy_file(source: Path, target: Path) -> None:
    """Copy a file, atomically; its folder is made."""
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)


@contextlib.contextmanager
def locked(path: str | os.PathLike[str], otherwise: str = "") -> Iterator[None]:
    """Hold an exclusive lock on the file `path` (created, never deleted).

    It waits for others; with `otherwise` never: a lock that another process has is then a Qs3Error
    in these words.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(path, "ab")  # noqa: SIM115
    except OSError as error:
        raise Qs3Error(f"cannot write the lock {path}: {error}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (fcntl.LOCK_NB if otherwise else 0))
        except BlockingIOError as error:
            raise Qs3Error(otherwise) from error
        yield


@contextlib.contextmanager
def owned(folder: str | Path, doing: str = "training in") -> Iterator[None]:
    """Own a folder, made if need be, until the block or the process ends; never wait."""
    path = make_folder(folder) / _LOCK
    with locked(path, f"another process is {doing} {folder}; wait for it, or choose another one"):
        yield
