"""What a script says that is run by a Python without the packages it needs.

Imports the standard library alone, so that it works there.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def needs_packages(folder: Path) -> Iterator[None]:
    """Imports inside end the process in one line if a package is not installed.

    Args:
        folder: the checkout, where `make install` puts `.venv`.

    Raises:
        SystemExit: with that line, and status 1.
        ModuleNotFoundError: a module of qs3's own is not there, which is a fault of qs3.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] == "qs3":
            raise
        install = "" if (folder / ".venv" / "installed").is_file() else "make install, then "
        sys.exit(
            f"{error.name} is not installed for {sys.executable}: {install}source "
            f"{folder / '.venv/bin/activate'} (python -m qs3 doctor says what else is missing)"
        )
