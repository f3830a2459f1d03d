"""Finished parts of work that is not finished, so that an interruption loses one part at most.

    recipe.json   what the parts are made with; another recipe is refused
    parts/        <name>.npz: arrays, and a note of plain values

The work is mostly a dataset, whose folder holds as well

    views/        images and depths of every view, if they were asked for
    clouds.png, config.yaml
"""

from __future__ import annotations

import io
import json
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import ConfigError, DataError
from qs3.store.meta import MadeOf, is_finished, read_meta
from qs3.utils.files import (
    make_folder,
    reading,
    remove_leftovers,
    sha256_file,
    write_bytes,
    write_json,
)

RECIPE, PARTS, VIEWS = "recipe.json", "parts", "views"
CLOUDS, CONFIG = "clouds.png", "config.yaml"

_MOST_LINES = 12


class PartFiles:
    """The parts in one folder; every file is written atomically."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._parts = folder / PARTS

    def check(self, recipe: Mapping[str, Any]) -> None:
        """Compare with the recipe that is there."""
        path = self.folder / RECIPE
        with reading(path):
            there = json.loads(path.read_bytes())
        if found := _differences(there, json.loads(json.dumps(recipe))):
            raise ConfigError(
                f"{self.folder} was made with other settings, objects or versions:\n"
                + "\n".join(found[:_MOST_LINES])
                + "\nUse the same ones, another folder, or force=true to start over."
            )

    def begin(self, recipe: Mapping[str, Any]) -> None:
        """Start, or continue what was made with the same recipe; raises as `check`."""
        if (self.folder / RECIPE).is_file():
            self.check(recipe)
        else:
            self.clear()  # parts without a recipe: it is not known what they were made with
            write_json(self.folder / RECIPE, recipe)
        make_folder(self._parts)
        for folder in (self.folder, self._parts):  # what killed processes left half written
            remove_leftovers(folder)

    def recipe_sha256(self) -> str:
        """Hash of what the parts are made with, as it is stored."""
        return sha256_file(self.folder / RECIPE)

    def check_there(self, recipe_sha256: str) -> None:
        """Check on another machine that it sees this folder, with the recipe that it works by."""
        try:
            same = self.recipe_sha256() == recipe_sha256
        except OSError:
            same = False
        if not same:
            raise DataError(
                f"{platform.node()} does not see {self.folder}, or it was begun anew: give a "
                "folder that all nodes see, or engine.shared_disk=false (engine=ray)"
            )

    def write(self, name: str, note: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Write one part, atomically; `note` is what JSON can hold."""
        text = np.frombuffer(json.dumps(note).encode(), dtype=np.uint8)
        # In memory first: a zip file that a full disk breaks off complains once more at its end.
        file = io.BytesIO()
        np.savez(file, note=text, **arrays)
        write_bytes(self._path(name), file.getvalue())

    def read(self, name: str) -> tuple[dict[str, Any], ArraysOnDisk]:
        """The note and the arrays of one part; DataError if it is damaged or not there.

        An array is read, each time, when it is asked for; it raises then, too.
        """
        path = self._path(name)
        with reading(path), np.load(path, allow_pickle=False) as file:
            note = json.loads(file["note"].tobytes())
            return note, ArraysOnDisk(path, [key for key in file.files if key != "note"])

    def has(self, name: str) -> bool:
        """Whether a part is written."""
        return self._path(name).is_file()

    def clear(self) -> None:
        """Remove the parts; the recipe stays."""
        if self._parts.is_dir():
            shutil.rmtree(self._parts)

    def count(self) -> int:
        """How many parts are written."""
        return len(list(self._parts.glob("*.npz")))

    def _path(self, name: str) -> Path:
        return self._parts / f"{name}.npz"


class ArraysOnDisk(Mapping[str, np.ndarray]):
    """The arrays of one part, by their names; see `PartFiles.read`."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self._path, self._names = path, list(names)

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise KeyError(name)
        with reading(self._path), np.load(self._path, allow_pickle=False) as file:
            return np.asarray(file[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def check_ours(folder: Path, command: str) -> None:
    """Refuse to make a dataset where a finished one lies that has no recipe: it was imported."""
    if is_finished(folder) and not (folder / RECIPE).is_file():
        raise DataError(
            f"{folder} holds a dataset that {command} did not make "
            f"({MadeOf.of(read_meta(folder))}) and never replaces; give another folder"
        )


def delete_dataset(folder: Path) -> None:
    """Delete a dataset, finished or not, and its recipe; other files are left alone."""
    # meta.yaml first: without it the folder counts as unfinished whatever else is left. The
    # recipe last: as long as a part is left, it says what the part was made with.
    (folder / "meta.yaml").unlink(missing_ok=True)
    for name in (PARTS, VIEWS):
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
    names = ("manifest.csv", CLOUDS, CONFIG)
    for path in [*(folder / name for name in names), *folder.glob("*.npy"), folder / RECIPE]:
        path.unlink(missing_ok=True)


def _differences(old: Any, new: Any, key: str = "") -> list[str]:
    """A line for each place where two recipes differ."""
    if old == new:
        return []
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            line
            for name in dict.fromkeys([*old, *new])
            for line in _differences(old.get(name), new.get(name), f"{key}.{name}" if key else name)
        ]
    return [f"  {key}: {json.dumps(old):.80} there, {json.dumps(new):.80} now"]
