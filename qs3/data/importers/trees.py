"""Folders of one file a cloud, `<class>/<split>/<name>.xyz` or `.npy`.

SpeckleNet10 and DepthScanNet10 are published as .xyz (text, 2048 rows of x y z), PointDA-10's
ModelNet10 and ShapeNet10 as .npy ([2048, 3] and [1024, 3]).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from qs3.clouds.files import parse_cloud
from qs3.data.importers.base import (
    Importer,
    Item,
    class_of,
    split_of,
    visible,
    y_up_to_z_up,
)
from qs3.data.manifest import SPLITS, ManifestRow
from qs3.errors import ConfigError, DataError

_SCANNET = re.compile(r"/(scene\d{4})_\d{2}(?:_|$)")


class Entry(NamedTuple):
    """One cloud's file, with its class and split in our names."""

    path: Path
    cls: str
    split: str

    @property
    def id(self) -> str:
        """Class, split and the file's name without its extension."""
        return f"{self.cls}/{self.split}/{self.path.stem}"


@dataclass(frozen=True)
class TreeImporter(Importer):
    """The part of a tree's reading that does not depend on the files' format.

    Clouds come split by split, in each class by class, in each sorted by name: the order in
    which the code of the lineage lists them, and by which it cuts off its validation part.

    Attributes:
        up: axis that points up in the files, "z" or "y"; y is turned to z.
        up_z_classes: classes whose files have z up although `up` is "y" (ShapeNet10's plants).
    """

    up: str = "z"
    up_z_classes: Sequence[str] = ()
    suffix: ClassVar[str]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.up not in ("y", "z"):
            raise ConfigError(f"up of {type(self).__name__} is {self.up!r}, expected 'y' or 'z'")
        object.__setattr__(self, "up_z_classes", list(self.up_z_classes))

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        return [f"{self.root}/<class>/{{train,test}}/*{self.suffix}"]

    def is_there(self) -> bool:
        """See `Importer`: whether the folder has a subfolder."""
        return self.root.is_dir() and any(e.is_dir() for e in visible(self.root, self.root))

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`."""
        return [
            Item(
                ManifestRow(e.id, e.cls, e.split, origin=str(e.path.relative_to(self.root))),
                str(e.path),
                functools.partial(parse_cloud, e.path),
            )
            for e in list_tree(self.root, self.suffix, classes)
        ]

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        return y_up_to_z_up(cloud) if self.up == "y" and cls not in self.up_z_classes else cloud


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


def list_tree(root: Path, suffix: str, classes: Sequence[str]) -> list[Entry]:
    """All clouds of `root/<class>/<split>/*suffix`, in the order of `TreeImporter`.

    Hidden files and other extensions are passed over.

    Raises:
        DataError: unknown class or split, two folders of one class, two files of one name, a
            name that is not UTF-8, or a link that leads out of `root`.
    """
    entries: dict[str, Entry] = {}
    folders: dict[tuple[str, str], Path] = {}
    for class_folder in (e for e in visible(root, root) if e.is_dir()):
        cls = class_of(class_folder.name, classes, str(root))
        for split_folder in (e for e in visible(class_folder, root) if e.is_dir()):
            split = split_of(split_folder.name, str(class_folder))
            if (cls, split) in folders:
                raise DataError(f"{split_folder} and {folders[cls, split]} are the same class")
            folders[cls, split] = split_folder
            for path in visible(split_folder, root):
                if path.suffix.lower() != suffix or not path.is_file():
                    continue
                entry = Entry(path, cls, split)
                name = entry.id.casefold()  # other systems do not tell a.xyz from A.XYZ
                if name in entries:
                    raise DataError(f"{path} and {entries[name].path} have one name; rename one")
                entries[name] = entry
    return sorted(
        entries.values(),
        key=lambda e: (SPLITS.index(e.split), classes.index(e.cls), e.path.name),
    )
