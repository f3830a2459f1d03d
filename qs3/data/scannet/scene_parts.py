"""The unfinished dataset: the clouds of each scene in a file of their own.

The parts stay beside the finished dataset: scenes that come later are added to them. They hold as
much as the dataset, and may be deleted when it is complete.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qs3.data.dataset_folder import RECIPE
from qs3.data.parts import PartFiles
from qs3.data.scannet.files import SceneFiles
from qs3.data.scannet.labels import Labelled
from qs3.data.scannet.objects import ObjectCloud
from qs3.data.scannet.scene import SceneResult
from qs3.errors import DataError

_COUNTS = ("frames", "frames_used", "frames_lost", "frames_unmasked")


class SceneParts(PartFiles):
    """The parts in one dataset's folder."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, elsewhere="out")

    def check(self, recipe: Mapping[str, Any]) -> None:
        """Check that what is in the folder, if anything, was made with the same recipe.

        Raises:
            ConfigError: it was not; the message lists the settings that differ.
            DataError: nobody knows what it was made with.
        """
        if self.have_recipe:
            super().check(recipe)
        elif others := [p.name for p in self.folder.iterdir() if not p.name.startswith(".")]:
            raise DataError(
                f"{self.folder} holds {', '.join(sorted(others)[:3])} and no {RECIPE}, so it was "
                "not made by this command; give an empty folder, or force=true to replace a dataset"
            )

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
        self.write(result.files.scene, note, clouds)

    def done(self, files: SceneFiles) -> bool:
        """Whether there is a part of the scene, made from files of these sizes for this split.

        Raises:
            DataError: the part is damaged.
        """
        if not self.has(files.scene):
            return False
        note, _ = self.read(files.scene)
        return note["split"] == files.split and note["sizes"] == files.sizes()

    def load(self, files: SceneFiles) -> SceneResult:
        """One scene.

        Raises:
            DataError: the part is damaged, or gone.
        """
        note, clouds = self.read(files.scene)
        objects = tuple(
            ObjectCloud(
                Labelled(one["object_id"], one["label"], one["cls"]),
                tuple(one["frames"]),
                one["candidates"],
                one["fused_points"],
                clouds.get(str(one["object_id"])),
                one["reason"],
            )
            for one in note["objects"]
        )
        counts = {key: note[key] for key in _COUNTS}
        return SceneResult(files, objects, **counts, notes=tuple(note["notes"]))
