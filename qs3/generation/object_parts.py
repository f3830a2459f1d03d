"""The unfinished dataset of a generation: what became of each object, in a file of its own."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import overload

import numpy as np

from qs3.data.parts import PartFiles
from qs3.generation.recipes import Cloud
from qs3.generation.workers import Outcome

_PREVIEW = "preview_"


class Parts(PartFiles):
    """The parts of one dataset's folder; an object's file is named by the hash of its id."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, elsewhere="paths.data_dir")

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
