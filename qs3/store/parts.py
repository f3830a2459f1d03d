"""The unfinished dataset: one file an object or scene, so that an interruption loses at most one.

recipe.json    what the parts were made with; another recipe is refused
parts/         <name>.npz: the arrays, and a line of JSON with the rest
"""

from __future__ import annotations

import contextlib
import io
import json
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import ConfigError, DataError
from qs3.store.dataset_folder import PARTS, RECIPE
from qs3.utils.files import (
    make_folder,
    remove_leftovers,
    sha256_file,
    write_bytes,
    write_json,
)
from qs3.utils.memory import JSON_PEAK, read_whole

_MOST_LINES = 12


class PartFiles:
    """The parts in one dataset's folder.

    Args:
        folder: of the dataset.
        elsewhere: the setting that names another folder, for messages: "out".
    """

    def __init__(self, folder: Path, elsewhere: str) -> None:
        self.folder = folder
        self._elsewhere = elsewhere
        self._parts = folder / PARTS

    @property
    def are_there(self) -> bool:
        """Whether there is a folder of parts."""
        return self._parts.is_dir()

    @property
    def have_recipe(self) -> bool:
        """Whether it is known what the parts, or the dataset, were made with."""
        return (self.folder / RECIPE).is_file()

    def check(self, recipe: Mapping[str, Any]) -> None:
        """Raise ConfigError (what differs, what to do) if the folder was begun otherwise.

        Raises:
            DataError: there is no recipe that can be read.
        """
        path = self.folder / RECIPE
        try:
            there = json.loads(read_whole(path, JSON_PEAK))
        except (OSError, ValueError, RecursionError) as error:
            raise DataError(
                f"{path} cannot be read ({error}): use force=true to start over"
            ) from error
        found = _differences(there, json.loads(json.dumps(recipe)))
        if [key for key, _, _ in found] == ["objects"]:
            raise ConfigError(
                f"{self.folder} was made from other objects: {found[0][1]} there, {found[0][2]} "
                "now. A dataset is of one set of objects, and another limit= or splits=, or a mesh "
                "that was repaired, added or removed, makes another: give another "
                f"{self._elsewhere}, or force=true to make all of it again."
            )
        if found:
            lines = [f"  {key}: {old} there, {new} now" for key, old, new in found]
            raise ConfigError(
                f"{self.folder} was made with other settings or versions, and mixing them is "
                "refused:\n" + "\n".join(lines[:_MOST_LINES]) + "\nUse the same settings, another "
                f"{self._elsewhere}, or force=true to start over."
            )

    def begin(self, recipe: Mapping[str, Any]) -> None:
        """Start, or continue what was made with the same recipe; raises as `check`."""
        if self.have_recipe:
            self.check(recipe)
        else:
            self.clear()  # parts without a recipe: nobody knows what they were made with
            write_json(self.folder / RECIPE, recipe)
        make_folder(self._parts)
        self.tidy()

    def recipe_sha256(self) -> str:
        """Hash of what the parts are made with, as it is stored."""
        return sha256_file(self.folder / RECIPE)

    def check_there(self, recipe_sha256: str) -> None:
        """On another machine: that it sees this folder, and with the recipe that it works by.

        Raises:
            DataError: it does not, and what it saved would be lost, or mixed with other objects.
        """
        try:
            found = self.recipe_sha256()
        except OSError as error:
            raise DataError(
                f"{platform.node()} does not see {self.folder} ({error.strerror}): give a "
                f"{self._elsewhere} that all nodes see, or engine.shared_disk=false (engine=ray)"
            ) from error
        if found != recipe_sha256:
            raise DataError(
                f"{self.folder} was begun anew with other settings while {platform.node()} worked "
                "by the old ones"
            )

    def tidy(self) -> None:
        """Remove what killed processes left half written; nobody may be writing."""
        remove_leftovers(self.folder)
        remove_leftovers(self._parts)

    def write(self, name: str, note: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Write one part, atomically; `note` is what JSON can hold."""
        text = np.frombuffer(json.dumps(note).encode(), dtype=np.uint8)
        # In memory first: a zip file that a full disk breaks off complains once more at its end.
        file = io.BytesIO()
        np.savez(file, note=text, **arrays)
        write_bytes(self._path(name), file.getvalue())

    def read(self, name: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """The note and the arrays of one part; DataError if it is damaged or not there."""
        note, arrays = self.open(name)
        return note, dict(arrays)

    def open(self, name: str) -> tuple[dict[str, Any], ArraysOnDisk]:
        """The same, but an array is read, each time, when it is asked for; it raises then, too."""
        path = self._path(name)
        with _opened(path) as file:
            note = json.loads(file["note"].tobytes())
            return note, ArraysOnDisk(path, [key for key in file.files if key != "note"])

    def has(self, name: str) -> bool:
        """Whether a part is written."""
        return self._path(name).is_file()

    def count(self) -> int:
        """How many parts are written."""
        return len(list(self._parts.glob("*.npz")))

    def clear(self) -> None:
        """Remove the parts; the recipe stays."""
        if self._parts.is_dir():
            shutil.rmtree(self._parts)

    def _path(self, name: str) -> Path:
        return self._parts / f"{name}.npz"


class ArraysOnDisk(Mapping[str, np.ndarray]):
    """The arrays of one part, by their names; see `PartFiles.open`."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self._path, self._names = path, list(names)

    def only(self, names: Sequence[str]) -> ArraysOnDisk:
        """Some of them."""
        return ArraysOnDisk(self._path, names)

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise KeyError(name)
        with _opened(self._path) as file:
            return np.asarray(file[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        with np.load(path, allow_pickle=False) as file:
            yield file
    except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
        raise DataError(f"{path} is damaged ({error}): delete it and run again") from error


def _differences(old: Any, new: Any, key: str = "") -> list[tuple[str, Any, Any]]:
    if old == new:
        return []
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            difference
            for name in dict.fromkeys([*old, *new])
            for difference in _differences(
                old.get(name, "nothing"),
                new.get(name, "nothing"),
                f"{key}.{name}" if key else name,
            )
        ]
    if key == "objects" and isinstance(old, list) and isinstance(new, list):
        return [(key, _sample(old, new), _sample(new, old))]
    return [(key, _short(old), _short(new))]


def _sample(some: list, others: list) -> str:
    """How many there are, and the first that the others lack."""
    missing = sorted(set(some) - set(others))
    return f"{len(some)}{f', among them {missing[0]!r}' if missing else ''}"


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else text[:77] + "..."
