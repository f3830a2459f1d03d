"""The unfinished dataset: the clouds of each scene in a file of their own.

The parts stay next to the finished dataset: scenes that come later are added to them. They hold
as much as the dataset, and may be deleted when it is complete.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qs3.datasets.scannet.files import SceneFiles
from qs3.datasets.scannet.labels import Labelled
from qs3.datasets.scannet.objects import ObjectCloud
from qs3.datasets.scannet.scene import SceneResult
from qs3.errors import DataError
from qs3.store.parts import RECIPE, PartFiles

_PLAIN = ("frames", "frames_used", "frames_lost", "frames_unmasked", "notes")


class SceneParts(PartFiles):
    """The parts in one dataset's folder."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)

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
        objects = result.objects
        note = {
            "split": result.files.split,
            "sizes": result.files.sizes(),
            "plain": {key: getattr(result, key) for key in _PLAIN},
            "objects": [dataclasses.asdict(dataclasses.replace(o, cloud=None)) for o in objects],
        }
        clouds = {str(o.labelled.object_id): o.cloud for o in objects if o.cloud is not None}
        self.write(result.files.scene, note, clouds)

    def done(self, files: SceneFiles) -> bool:
        """Whether there is a part of the scene, made from files of these sizes for this split."""
        if not self.has(files.scene):
            return False
        note, _ = self.read(files.scene)
        return note["split"] == files.split and note["sizes"] == files.sizes()

    def load(self, files: SceneFiles) -> SceneResult:
        """One scene; DataError if its part is damaged, or gone."""
        note, clouds = self.read(files.scene)
        objects = []
        for one in note["objects"]:
            labelled = Labelled(**one.pop("labelled"))
            one |= {"frames": tuple(one["frames"]), "cloud": clouds.get(str(labelled.object_id))}
            objects.append(ObjectCloud(labelled, **one))
        return SceneResult(files, tuple(objects), **note["plain"])
