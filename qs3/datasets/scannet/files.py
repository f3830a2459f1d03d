"""Which files a scene has, which scenes there are, and of which split each one is."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from qs3.datasets.scannet.labels import is_scene
from qs3.errors import DataError, MissingDataError
from qs3.utils.plural import counted

log = logging.getLogger(__name__)

_SUFFIXES = {
    "sens": ".sens",
    "instances": "_2d-instance-filt.zip",
    "labels": "_2d-label-filt.zip",
    "aggregation": ".aggregation.json",
}


@dataclass(frozen=True)
class SceneFiles:
    """A scene's files; those that are not there are None.

    Attributes:
        scene: its name, e.g. "scene0000_00".
        split: "train" or "test".
        sens, instances: the recording and the zip of instance masks; both are needed.
        aggregation: the list of objects; needed.
        labels: the zip of label masks, which checks the classes.
    """

    scene: str
    split: str
    sens: Path | None
    instances: Path | None
    labels: Path | None
    aggregation: Path | None

    @staticmethod
    def find(folder: Path, split: str) -> SceneFiles:
        """Those in a scene's folder, under ScanNet's names."""
        paths = {role: folder / f"{folder.name}{suffix}" for role, suffix in _SUFFIXES.items()}
        there = {role: path if path.is_file() else None for role, path in paths.items()}
        return SceneFiles(folder.name, split, **there)

    def need(self, role: str) -> Path:
        """The file of a role, such as "sens".

        Raises:
            DataError: it is not there.
        """
        path: Path | None = getattr(self, role)
        if path is None:
            raise DataError(f"{self.scene}{_SUFFIXES[role]} is not there; download it")
        return path

    def sizes(self) -> dict[str, int]:
        """Bytes of each file, by its role: another size means another file."""
        paths = {role: getattr(self, role) for role in _SUFFIXES}
        return {role: path.stat().st_size for role, path in paths.items() if path is not None}


def find_scenes(scans: Path, train: Sequence[str], test: Sequence[str]) -> list[SceneFiles]:
    """The scenes in `scans`, one folder each, with the split that the lists of names give them.

    Raises:
        MissingDataError: there is no such folder, or no scene of the lists in it.
        DataError: a scene is in both lists.
    """
    if both := sorted(set(train) & set(test)):
        raise DataError(f"{both[0]} is in the list of train and in that of test ({len(both)} are)")
    if not scans.is_dir():
        raise MissingDataError(f"there is no folder {scans}")
    split_of = {**dict.fromkeys(train, "train"), **dict.fromkeys(test, "test")}
    there = sorted(path.name for path in scans.iterdir() if path.is_dir() and is_scene(path.name))
    scenes = [SceneFiles.find(scans / name, split_of[name]) for name in there if name in split_of]
    if not scenes:
        raise MissingDataError(
            f"{scans} holds none of the {len(split_of)} scenes of the lists, only "
            f"{counted(len(there), 'other')}; it should hold folders like scene0000_00 (ScanNet's "
            "folder `scans`)"
        )
    splits = [files.split for files in scenes]
    log.info("scenes that are there: train %d, test %d", *map(splits.count, ("train", "test")))
    absent = sorted(set(split_of) - set(there))
    unlisted = [name for name in there if name not in split_of]
    for names, what in ((absent, "of the lists not there"), (unlisted, "there, but in no list")):
        if names:
            log.info("%s %s, first %s", counted(len(names), "scene"), what, names[0])
    return scenes
