"""A run that failed before it began leaves no folder, which Hydra makes before all checks."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from qs3.errors import Qs3Error
from qs3.runs.folder import STARTED

_HYDRAS = {".hydra": ("config.yaml", "hydra.yaml", "overrides.yaml")}
_LOG, _LOCK = "train.log", ".lock"
_FILES = (_LOG, _LOCK, STARTED)  # of the last nothing is left to go on with before an epoch is done


@contextlib.contextmanager
def removed_if_unbegun(folder: Path) -> Iterator[None]:
    """After an error for people in the block, remove a folder that tells nothing of a run."""
    try:
        yield
    except Qs3Error:
        with contextlib.suppress(OSError):  # no rights, or somebody wrote there just now
            _remove(folder)
        raise


def is_unbegun(folder: Path) -> bool:
    """Whether a start of `train.py` that failed at once is all that left something there."""
    return (folder / _LOG).is_file() and _is_bare(folder)


def _is_bare(folder: Path) -> bool:
    """Whether nothing lies there but what a start writes before it trains."""
    for path in folder.iterdir():
        known = path.name in _FILES and path.is_file()
        if path.name in _HYDRAS and path.is_dir() and not path.is_symlink():
            known = all(one.name in _HYDRAS[path.name] for one in path.iterdir())
        if not known:
            return False
    return True


def _remove(folder: Path) -> None:
    """Remove an unbegun run's folder, and that of its experiment if nothing else is in it.

    File by file: what another process writes meanwhile stays, and the folder with it.
    """
    lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # OSError: another process trains there
        if not _is_bare(folder):
            return
        for name, files in _HYDRAS.items():
            for file in files:
                (folder / name / file).unlink(missing_ok=True)
            if (folder / name).is_dir():
                (folder / name).rmdir()
        for name in (_LOG, STARTED):
            (folder / name).unlink(missing_ok=True)
        (folder / _LOCK).unlink()
        folder.rmdir()
        folder.parent.rmdir()
    finally:
        os.close(lock)
