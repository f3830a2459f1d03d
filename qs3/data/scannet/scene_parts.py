"""The unfinished dataset: one file a scene, so that an interruption loses at most one.

recipe.json    what the parts were made with; another recipe is refused
parts/         <scene>.npz: the clouds, and a line of JSON with the rest

The parts stay beside the finished dataset: scenes that come later are added to them. They hold as
much as the dataset, and may be deleted when it is complete.
"""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from qs3.data.dataset_folder import PARTS, RECIPE
from qs3.data.scannet.files import SceneFiles
from qs3.data.scannet.labels import Labelled
from qs3.data.scannet.objects import ObjectCloud
from qs3.data.scannet.scene import SceneResult
from qs3.errors import ConfigError, DataError
from qs3.utils.files import make_folder, remove_leftovers, write_bytes, write_json

_COUNTS = ("frames", "frames_used", "frames_lost", "frames_unmasked")


class SceneParts:
    """The parts in one dataset's folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._parts = folder / PARTS

    @property
    def are_there(self) -> bool:
        """Whether there is a folder of parts."""
        return self._parts.is_dir()

    def check(self, recipe: dict[str, Any]) -> None:
        """Check that what is in the folder, if anything, was made with the same recipe.

        Raises:
            ConfigError: it was not; the message lists the settings that differ.
            DataError: nobody knows what it was made with.
        """
        path = self._folder / RECIPE
        if path.is_file():
            _check_same(path, recipe)
        else:
            others = [p.name for p in self._folder.iterdir() if not p.name.startswith(".")]
            if others:
                raise DataError(
                    f"{self._folder} holds {', '.join(sorted(others)[:3])} and no {RECIPE}, so it "
                    "was not made by this command; give an empty folder, or force=true to replace "
                    "a dataset"
                )

    def begin(self, recipe: dict[str, Any]) -> None:
        """Start or continue, after `check`."""
        if not (self._folder / RECIPE).is_file():
            write_json(self._folder / RECIPE, recipe)
        make_folder(self._parts)
        self.tidy()

    def tidy(self) -> None:
        """Remove what killed processes left half written; nobody may be writing."""
        remove_leftovers(self._folder)
        remove_leftovers(self._parts)

    def save(self, result: SceneResult) -> None:
        """Write one scene, atomically."""
        note = {
            "split": result.files.split,
            "sizes": result.files.sizes(),
            **{key: getattr(result, key) for key in _COUNTS},
            "notes": result.notes,
            "objects": [
                {
                    **dataclasses.asdict(one.labelled),
                    "frames": one.frames,
                    "candidates": one.candidates,
                    "fused_points": one.fused_points,
                    "reason": one.reason,
                }
                for one in result.objects
            ],
        }
        clouds = {
            str(one.labelled.object_id): one.cloud
            for one in result.objects
            if one.cloud is not None
        }
        text = np.frombuffer(json.dumps(note).encode(), dtype=np.uint8)
        # In memory first: a zip file that a full disk breaks off complains once more at its end.
        file = io.BytesIO()
        np.savez(file, note=text, **clouds)
        write_bytes(self._path(result.files.scene), file.getvalue())

    def has(self, files: SceneFiles) -> bool:
        """Whether there is a part of the scene, made from files of these sizes for this split.

        Raises:
            DataError: the part is damaged.
        """
        if not self._path(files.scene).is_file():
            return False
        note, _ = self._read(files.scene)
        return note["split"] == files.split and note["sizes"] == files.sizes()

    def load(self, files: SceneFiles) -> SceneResult:
        """One scene.

        Raises:
            DataError: the part is damaged, or gone.
        """
        note, clouds = self._read(files.scene)
        objects = tuple(
            ObjectCloud(
                Labelled(one["object_id"], one["label"], one["cls"]),
                tuple(one["frames"]),
                one["candidates"],
                one["fused_points"],
                clouds.get(one["object_id"]),
                one["reason"],
            )
            for one in note["objects"]
        )
        counts = {key: note[key] for key in _COUNTS}
        return SceneResult(files, objects, **counts, notes=tuple(note["notes"]))

    def _read(self, scene: str) -> tuple[dict[str, Any], dict[int, np.ndarray]]:
        """The note and the clouds by object id."""
        path = self._path(scene)
        try:
            with np.load(path, allow_pickle=False) as file:
                note = json.loads(file["note"].tobytes())
                return note, {int(name): file[name] for name in file.files if name != "note"}
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise DataError(f"{path} is damaged ({error}): delete it and run again") from error

    def _path(self, scene: str) -> Path:
        return self._parts / f"{scene}.npz"


def _check_same(path: Path, recipe: dict[str, Any]) -> None:
    try:
        there = _flat(json.loads(path.read_text()))
    except (OSError, ValueError, AttributeError) as error:
        raise DataError(f"{path} cannot be read ({error}): use force=true to start over") from error
    now = _flat(recipe)
    if there == now:
        return
    nothing = "nothing"
    lines = [
        f"  {key}: {there.get(key, nothing)} there, {now.get(key, nothing)} now"
        for key in sorted({*there, *now})
        if there.get(key, nothing) != now.get(key, nothing)
    ]
    raise ConfigError(
        f"{path.parent} was made with other settings or versions, and mixing them is refused:\n"
        + "\n".join(lines)
        + "\nUse the same settings, another out, or force=true to start over."
    )


def _flat(recipe: dict[str, Any]) -> dict[str, Any]:
    """Two levels of keys as one."""
    return {f"{a}.{b}": value for a, inner in recipe.items() for b, value in inner.items()}
