"""Locks between processes: one that waits, one that refuses. Gone when the process ends."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from qs3.errors import Qs3Error
from qs3.utils.files import make_folder

_NAME = ".lock"


@contextlib.contextmanager
def locked(path: str | os.PathLike[str]) -> Iterator[None]:
    """Hold an exclusive lock on the file `path` (created, never deleted); wait for others."""
    with _open_lock(Path(path)) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


@contextlib.contextmanager
def owned(
    folder: str | Path,
    doing: str = "training in",
    advice: str = "wait for it, stop it, or choose another seed or experiment_name",
) -> Iterator[None]:
    """Own a folder, made if need be, until the block or the process ends; never wait.

    Raises:
        Qs3Error: another process owns it (`doing` something in it; with `advice`), or it cannot
            be made or written to.
    """
    folder = make_folder(folder)
    with alone(folder / _NAME, f"another process is {doing} {folder}; {advice}"):
        yield


@contextlib.contextmanager
def alone(path: str | os.PathLike[str], otherwise: str) -> Iterator[None]:
    """Hold an exclusive lock on the file `path` (created, never deleted); never wait.

    Raises:
        Qs3Error: another process has it: what `otherwise` says; or it cannot be written.
    """
    with _open_lock(Path(path)) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise Qs3Error(otherwise) from error
        yield


def check_idle(folder: Path) -> None:
    """Raise Qs3Error if another process trains in the folder, which need not be writable."""
    path = folder / _NAME
    if not os.access(path, os.R_OK):
        return  # a copy, which nobody locks
    with open(path, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError as error:
            raise Qs3Error(
                f"another process is training in {folder}; wait for it or stop it"
            ) from error


def _open_lock(path: Path) -> BinaryIO:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return open(path, "ab")
    except OSError as error:
        raise Qs3Error(
            f"cannot write the lock {path} ({error.strerror or error}); check the permissions or "
            "choose another folder"
        ) from error
