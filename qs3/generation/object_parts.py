"""The unfinished dataset of a generation: what became of each object, in a file of its own.

Beside them lies which code made them (`code.txt`). A finished dataset is not asked for it, as every
change of the code would make it another: `meta.yaml` has it in the recipe's fingerprint.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from qs3.errors import ConfigError
from qs3.generation.recipes import Cloud
from qs3.generation.workers import Outcome
from qs3.store.parts import PartFiles
from qs3.utils.files import write_text
from qs3.utils.memory import read_whole

ELSEWHERE = "paths.data_dir (or domain.path, where that is given)"
"""Settings that name another folder, for messages."""

_PREVIEW = "preview_"
_CODE = "code.txt"


class Parts(PartFiles):
    """The parts of one dataset's folder; an object's file is named by the hash of its id."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)

    def begin_by(self, code: str, recipe: Mapping[str, Any]) -> None:
        """Start, or continue what the same code made with the same recipe.

        Args:
            code: its `code_fingerprint`.
            recipe: see `PartFiles.begin`, which raises where it is another.

        Raises:
            ConfigError: there are parts that other code made, so that one dataset would be of two.
        """
        self.begin(recipe)
        if self.count() and self._code() != code.encode():
            raise ConfigError(
                f"{self.folder} was begun with another version of qs3's code, which may make other "
                f"clouds, and mixing them is refused: finish it with that version "
                f"({self.count()} objects are done), give another {ELSEWHERE}, or force=true to "
                "start over"
            )
        write_text(self._parts / _CODE, code)

    def _code(self) -> bytes:
        try:
            return read_whole(self._parts / _CODE, peak=1)
        except OSError:
            return b""  # of versions that did not write it

    def save(self, outcome: Outcome) -> None:
        """Write one outcome, atomically."""
        cloud = outcome.cloud
        note = {
            "item_id": outcome.item_id,
            "mesh_sha256": outcome.mesh_sha256,
            "reason": outcome.reason,
            "note": outcome.note,
            "seconds": outcome.seconds,
            "memory_mb": outcome.memory_mb,
            "views": cloud.views if cloud else 0,
            "valid_points": cloud.valid_points if cloud else 0,
        }
        arrays = dict(cloud.arrays) if cloud else {}
        if cloud:
            arrays |= {_PREVIEW + name: image for name, image in cloud.preview.items()}
        self.write(_name(outcome.item_id), note, arrays)

    def load(self, item_id: str) -> Outcome | None:
        """One outcome, or None if it is not there yet.

        Its arrays stay on disk until they are asked for: all objects' need not fit into memory.
        """
        if not self.done(item_id):
            return None
        note, found = self.open(_name(item_id))
        seen = [name for name in found if name.startswith(_PREVIEW)]
        arrays = found.only([name for name in found if name not in seen])
        preview = {name.removeprefix(_PREVIEW): found[name] for name in seen}
        cloud = None
        if arrays:
            cloud = Cloud(arrays, note["views"], note["valid_points"], preview=preview)
        same = {key: note[key] for key in ("item_id", "mesh_sha256", "reason", "note")}
        costs = {key: note.get(key, 0.0) for key in ("seconds", "memory_mb")}
        return Outcome(cloud=cloud, **same, **costs)

    def done(self, item_id: str) -> bool:
        """Whether an outcome is saved."""
        return self.has(_name(item_id))

    def state(self, total: int) -> str:
        """How much is done, as a sentence."""
        return f"{self.count()} of {total} objects are done and kept."


class InParts(Sequence[np.ndarray]):
    """One array of many clouds, each read when it is asked for."""

    def __init__(self, clouds: Sequence[Cloud], name: str) -> None:
        self._clouds, self._name = clouds, name

    def __len__(self) -> int:
        return len(self._clouds)

    @overload
    def __getitem__(self, key: int) -> np.ndarray: ...

    @overload
    def __getitem__(self, key: slice) -> list[np.ndarray]: ...

    def __getitem__(self, key: int | slice) -> np.ndarray | list[np.ndarray]:
        if isinstance(key, slice):
            return [cloud.arrays[self._name] for cloud in self._clouds[key]]
        return self._clouds[key].arrays[self._name]


def _name(item_id: str) -> str:
    return hashlib.sha256(item_id.encode()).hexdigest()[:32]
