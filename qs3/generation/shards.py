"""The unfinished dataset: one file an object, so that an interruption loses at most one.

recipe.json    what the parts were made with; another recipe is refused
parts/         <sha256 of the id>.npz: the arrays, and a line of JSON with the rest
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from qs3.data.dataset_folder import PARTS, RECIPE
from qs3.errors import ConfigError, DataError
from qs3.generation.recipes import Cloud
from qs3.generation.workers import Outcome
from qs3.utils.files import make_folder, remove_leftovers, write_bytes, write_json

_PREVIEW = "preview_"


class Parts:
    """The parts of one dataset's folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._parts = folder / PARTS

    def begin(self, recipe: dict[str, Any]) -> None:
        """Start, or check that what is there was made with the same recipe.

        Raises:
            ConfigError: it was not; the message lists the settings that differ.
        """
        path = self.folder / RECIPE
        if path.is_file():
            check_same_recipe(self.folder, recipe)
        else:
            self.clear()  # parts without a recipe: nobody knows what they were made with
            write_json(path, recipe)
        make_folder(self._parts)
        remove_leftovers(self._parts)

    def save(self, outcome: Outcome) -> None:
        """Write one outcome, atomically."""
        cloud = outcome.cloud
        note = {
            "item_id": outcome.item_id,
            "mesh_sha256": outcome.mesh_sha256,
            "reason": outcome.reason,
            "note": outcome.note,
            "views": cloud.views if cloud else 0,
            "valid_points": cloud.valid_points if cloud else 0,
        }
        arrays = dict(cloud.arrays) if cloud else {}
        if cloud:
            arrays |= {_PREVIEW + name: image for name, image in cloud.preview.items()}
        text = np.frombuffer(json.dumps(note).encode(), dtype=np.uint8)
        # In memory first: a zip file that a full disk breaks off complains once more at its end.
        file = io.BytesIO()
        np.savez(file, note=text, **arrays)
        write_bytes(self._path(outcome.item_id), file.getvalue())

    def load(self, item_id: str) -> Outcome | None:
        """One outcome, or None if it is not there yet."""
        path = self._path(item_id)
        try:
            with np.load(path, allow_pickle=False) as file:
                note = json.loads(file["note"].tobytes())
                found = {name: file[name] for name in file.files if name != "note"}
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise DataError(f"{path} is damaged ({error}): delete it and run again") from error
        arrays = {name: array for name, array in found.items() if not name.startswith(_PREVIEW)}
        preview = {
            name.removeprefix(_PREVIEW): array
            for name, array in found.items()
            if name.startswith(_PREVIEW)
        }
        cloud = None
        if arrays:
            cloud = Cloud(arrays, note["views"], note["valid_points"], preview=preview)
        return Outcome(
            note["item_id"], note["mesh_sha256"], cloud, note["reason"], note=note["note"]
        )

    def done(self, item_id: str) -> bool:
        """Whether an outcome is saved."""
        return self._path(item_id).is_file()

    def state(self, total: int) -> str:
        """How much is done, as a sentence."""
        done = len(list(self._parts.glob("*.npz"))) if self._parts.is_dir() else 0
        return f"{done} of {total} objects are done and kept."

    def clear(self) -> None:
        """Remove the parts; the recipe stays beside the finished dataset."""
        if self._parts.is_dir():
            shutil.rmtree(self._parts)

    def _path(self, item_id: str) -> Path:
        return self._parts / f"{hashlib.sha256(item_id.encode()).hexdigest()[:32]}.npz"


def check_same_recipe(folder: Path, recipe: dict[str, Any]) -> None:
    """Raise ConfigError if `folder` was begun with another recipe.

    Raises:
        ConfigError: lists what differs, and says what to do.
    """
    path = folder / RECIPE
    try:
        there = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({error}): use force=true to start over") from error
    now = json.loads(json.dumps(recipe))
    if there == now:
        return
    differences = [f"  {key}: {old} there, {new} now" for key, old, new in _differences(there, now)]
    raise ConfigError(
        f"{folder} was made with other settings or versions, and mixing them is refused:\n"
        + "\n".join(differences[:12])
        + "\nUse the same settings, another paths.data_dir, or force=true to start over."
    )


def _differences(old: Any, new: Any, key: str = "") -> list[tuple[str, Any, Any]]:
    if isinstance(old, dict) and isinstance(new, dict):
        out = []
        for name in [*old, *(n for n in new if n not in old)]:
            inner = f"{key}.{name}" if key else name
            out += _differences(old.get(name, "nothing"), new.get(name, "nothing"), inner)
        return out
    if old == new:
        return []
    if isinstance(old, list) and isinstance(new, list) and key == "objects":
        gone, come = sorted(set(old) - set(new)), sorted(set(new) - set(old))
        return [
            (
                key,
                f"{len(old)}{f', among them {gone[0]!r}' if gone else ''}",
                f"{len(new)}{f', among them {come[0]!r}' if come else ''}",
            )
        ]
    return [(key, _short(old), _short(new))]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else text[:77] + "..."
