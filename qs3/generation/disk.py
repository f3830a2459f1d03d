"""The disk of a dataset: errors of a folder that cannot be used and of a full disk."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Callable, Iterator
from pathlib import Path

from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.utils.files import make_folder

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS)


def check_folder(folder: Path, data_dir: str) -> None:
    """Make the dataset's folder.

    Raises:
        ConfigError: it cannot be made or written to; names paths.data_dir.
    """
    try:
        make_folder(folder)
    except (Qs3Error, ValueError) as error:  # ValueError: a null byte in the path
        raise ConfigError(
            f"paths.data_dir={data_dir} cannot be used: {error}. "
            "Give a folder that can be written to: paths.data_dir=PATH"
        ) from error


@contextlib.contextmanager
def disk_errors_explained(folder: Path, state: Callable[[], str]) -> Iterator[None]:
    """Say of a full disk how far the work is and how it continues.

    Args:
        folder: of the dataset.
        state: says how much is done.

    Raises:
        DataError: the disk is full, or the folder stopped being writable.
    """
    try:
        yield
    except (OSError, Qs3Error) as error:
        number = _errno(error)
        if number in _FULL:
            raise DataError(
                f"the disk is full, or a file became too large for it: {folder}\n  {error}\n"
                f"{state()} Free some space there and run the same command again: it continues."
            ) from error
        if number in _REFUSED and isinstance(error, OSError):
            raise DataError(f"cannot write in {folder}: {error}; check the permissions") from error
        raise


def _errno(error: BaseException) -> int | None:
    """Number of the system's error behind `error`."""
    seen: BaseException | None = error
    while seen is not None:
        number = getattr(seen, "errno", None)
        if number is not None:
            return int(number)
        seen = seen.__cause__
    return None
