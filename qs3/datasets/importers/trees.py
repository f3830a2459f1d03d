"""Folders of one file a cloud, `<class>/<split>/<name>.xyz` or `.npy`.

SpeckleNet10 and DepthScanNet10 are published as .xyz (text, 2048 rows of x y z), PointDA-10's
ModelNet10 and ShapeNet10 as .npy ([2048, 3] and [1024, 3]).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from qs3.classes import CLASSES, known_as
from qs3.config.checks import check_choice, check_words
from qs3.datasets.clouds.files import parse_cloud
from qs3.datasets.importers.base import (
    UP_AXES,
    Importer,
    Item,
    class_of,
    file_item,
    files_in,
    folders_in,
    split_of,
    turned,
    unique,
)
from qs3.errors import ConfigError, DataError
from qs3.store.manifest import SPLITS

_SCANNET = re.compile(r"/(scene\d{4})_\d{2}(?:_|$)")


@dataclass(frozen=True)
class TreeImporter(Importer):
    """The part of a tree's reading that does not depend on the files' format.

    Clouds come split by split, in each class by class, in each sorted by file name: the order in
    which the code of the lineage lists them, and by which it cuts off its validation part.

    Attributes:
        up: axis that points up in the files, one of `UP_AXES`.
        up_z_classes: classes whose files have z up whatever `up` is (ShapeNet10's plants).
    """

    up: str = "z"
    up_z_classes: Sequence[str] = ()
    suffix: ClassVar[str]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("published.up", self.up, UP_AXES)
        words = check_words("published.up_z_classes", self.up_z_classes)
        object.__setattr__(self, "up_z_classes", words)

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        return [f"{self.root}/<class>/{{train,test}}/*{self.suffix}"]

    def is_there(self) -> bool:
        """See `Importer`: whether the folder has a subfolder."""
        return self.root.is_dir() and any(folders_in(self.root, self.root))

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`.

        Raises:
            ConfigError: `up_z_classes` has a name that is none of the classes, nor of the ten.
            DataError: a file or folder that does not fit the format.
        """
        if unknown := sorted({*self.up_z_classes} - {*classes, *CLASSES}):
            raise ConfigError(
                f"published.up_z_classes names {', '.join(unknown)}, but the classes are "
                f"{', '.join(classes)}"
            )
        found = list_tree(self.root, self.suffix, lambda name: self._class_of(name, classes))
        order = sorted(found, key=lambda f: (SPLITS.index(f[2]), classes.index(f[1]), f[0].name))
        return unique(file_item(path, self.root, c, s, parse_cloud) for path, c, s in order)

    def _class_of(self, name: str, classes: Sequence[str]) -> str:
        """See `class_of`; where a folder that is none holds classes the tree lies deeper."""
        try:
            return class_of(name, classes, self.root)
        except DataError as error:
            inner = self.root / name
            if any(known_as(folder.name, classes) for folder in folders_in(inner, self.root)):
                raise DataError(f"{error}; {inner} holds them: move them to {self.root}") from error
            raise

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        return cloud if cls in self.up_z_classes else turned(cloud, self.up)


@dataclass(frozen=True)
class XyzTree(TreeImporter):
    """Text files: a row a point."""

    suffix: ClassVar[str] = ".xyz"

    def object_of(self, id_: str) -> str:
        """See `Importer`: the room, of ScanNet's ids such as "chair/test/scene0011_01_7".

        Rooms were scanned up to a dozen times (_00, _01, ...), with the same objects in them.
        """
        room = _SCANNET.search(id_)
        return room[1] if room else ""


@dataclass(frozen=True)
class NpyTree(TreeImporter):
    """One [n, 3] array a file; a pickled one is refused, since opening it could run anything."""

    suffix: ClassVar[str] = ".npy"


def list_tree(
    root: Path, suffix: str, class_named: Callable[[str], str | None]
) -> list[tuple[Path, str, str]]:
    """Path, class and split of all `root/<class>/<split>/*suffix`.

    Hidden files, other extensions, and folders of no class (None) are passed over.

    Raises:
        DataError: unknown split, two folders of one class and split, a name that is not UTF-8,
            or a link that leads out of `root`.
    """
    found: list[tuple[Path, str, str]] = []
    folders: dict[tuple[str, str], Path] = {}
    for class_folder in folders_in(root, root):
        cls = class_named(class_folder.name)
        if cls is None:
            continue
        for folder in folders_in(class_folder, root):
            split = split_of(folder.name, class_folder)
            other = folders.setdefault((cls, split), folder)
            if other is not folder:
                raise DataError(f"{folder} and {other} are the same class")
            found += [(path, cls, split) for path in files_in(folder, root, suffix)]
    return found
