"""Locks between processes, gone when the process ends."""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from qs3.errors import Qs3Error
from qs3.utils.files import make_folder

_NAME = ".lock"


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
    path = make_folder(folder) / _NAME
    with locked(path, f"another process is {doing} {folder}; wait for it, or choose another one"):
        yield
