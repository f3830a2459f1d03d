"""Published files that lie deeper than they are looked for, as an archive's own folder puts them.

A module of its own because an importer knows its own folder alone, and a domain no folders.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterator
from pathlib import Path

from qs3.datasets.importers.base import Importer

_LEVELS = 2
_MOST = 200  # folders: this is for a message


def lie_deeper(importer: Importer | None) -> list[str]:
    """A line for a message, if a folder up to two levels down holds what is looked for.

    Nothing of an importer of one file, which has its whole path in its settings.
    """
    if importer is None or importer.place != importer.root:
        return []
    for folder in itertools.islice(_below(importer.root, _LEVELS), _MOST):
        if dataclasses.replace(importer, folder=folder).is_there():
            return [f"Such files lie deeper, in {folder}: move what it holds to {importer.root}"]
    return []


def _below(root: Path, levels: int) -> Iterator[Path]:
    """Folders below, those of a level before the next one's; hidden ones are left out."""
    try:
        names = sorted(entry.name for entry in os.scandir(root) if entry.is_dir())
    except OSError:  # not there, or not ours to look into
        return
    folders = [root / name for name in names if not name.startswith(".")]
    yield from folders
    if levels > 1:
        for folder in folders:
            yield from _below(folder, levels - 1)
