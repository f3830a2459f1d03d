"""Your own clouds: a folder of files in any format of `qs3.clouds.files`, with labels or without.

    class/split/name.ext     split is train, test, or val (validation)
    split/class/name.ext
    class/name.ext           every `test_every`-th of a class, sorted by name, is for test
    name.ext, any/where.ext  no labels: all of it is the split "train"

A file may hold several clouds (.npy, .npz, .h5 with an array [m, n, 3]); they are then called
name_0000, name_0001, ... If it has labels, numbers count the classes from 0 and words are names.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from qs3.classes import known_as
from qs3.clouds.files import SUFFIXES, CloudFile, read_clouds, split_prefix
from qs3.data.importers.base import Importer, Item, class_of, split_of
from qs3.data.importers.trees import _visible
from qs3.data.manifest import SPLITS, ManifestRow
from qs3.errors import ConfigError, DataError
from qs3.settings import one_of, whole

log = logging.getLogger(__name__)

LAYOUTS = ("auto", "class/split", "split/class", "class", "none")
_SPLIT_NAMES = ("train", "test", "val", "validation")
_MANY = (".npy", ".npz", ".h5", ".hdf5")
_UP = {
    "z": ((0, 1, 2), (1, 1, 1)),
    "-z": ((0, 1, 2), (1, -1, -1)),
    "y": ((0, 2, 1), (1, -1, 1)),
    "-y": ((0, 2, 1), (1, 1, -1)),
    "x": ((2, 1, 0), (-1, 1, 1)),
    "-x": ((2, 1, 0), (1, 1, -1)),
}
"""Axis that points up -> which columns with which signs give x y z with z up: rotations by 90°."""


@dataclass(frozen=True)
class CloudFolder(Importer):
    """See the module. Clouds may have any number of points.

    A cloud with more than P points is thinned to its P farthest (farthest point sampling from the
    first on); one with fewer repeats its points. The manifest's `valid_points` says how many there
    were.

    Attributes:
        layout: one of those above; "auto" looks at the names of the folders.
        up: the axis that points up in the files: x, y, z, -x, -y or -z.
        test_every: of the layout "class"; 0 leaves nothing for test.
    """

    layout: str = "auto"
    up: str = "z"
    test_every: int = 5
    complete: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of("published.layout", self.layout, LAYOUTS)
        one_of("published.up", self.up, tuple(_UP))
        whole("published.test_every", self.test_every, 0)
        if self.test_every == 1:
            raise ConfigError("published.test_every=1 leaves nothing for training; 0 tests nothing")

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        kinds = " ".join(f"*{suffix}" for suffix in SUFFIXES)
        return [
            f"{self.root}/<class>/{{train,test}}/, <class>/, or without labels: {kinds} "
            "(published.folder=PATH)"
        ]

    def is_there(self) -> bool:
        """See `Importer`: whether there is any file of a known format."""
        return self.root.is_dir() and next(_files(self.root, self.root), None) is not None

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`. Sorted by split, class and name.

        Raises:
            DataError: an unknown class, two files of one name, mixed layouts, a damaged file of
                several clouds, or a link that leads out of the folder.
        """
        layout = self._layout(classes)
        log.info("%s is read in the layout %s", self.root, layout)
        rows: dict[str, Item] = {}
        for path in _files(self.root, self.root):
            cls, split = self._place(path, layout, classes)
            for item in self._of_file(path, cls, split, classes):
                if item.row.id in rows:
                    raise DataError(
                        f"{item.where} and {rows[item.row.id].where} have one name; rename one"
                    )
                rows[item.row.id] = item
        if self.test_every and layout == "class":
            rows = _with_tests(rows, self.test_every)
        order = {name: i for i, name in enumerate(classes)}
        return sorted(
            rows.values(),
            key=lambda f: (SPLITS.index(f.row.split), order.get(f.row.cls, -1), f.row.id),
        )

    def thin(self, cloud: np.ndarray, where: str) -> np.ndarray:
        """See `Importer`: at most P points, the farthest."""
        if cloud.ndim != 2 or len(cloud) <= self.points:
            return cloud
        from qs3.geometry.sampling import farthest_point_sampling_np

        return cloud[farthest_point_sampling_np(cloud, self.points, 0)]

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        columns, signs = _UP[self.up]
        return cloud[:, columns] * np.array(signs, dtype=cloud.dtype)

    def _layout(self, classes: Sequence[str]) -> str:
        """The layout in the names of the folders.

        Raises:
            DataError: they fit none.
        """
        if self.layout != "auto":
            return self.layout
        folders = [e for e in _visible(self.root, self.root) if e.is_dir()]
        folders = [f for f in folders if next(_files(f, self.root), None) is not None]
        if not folders:
            return "none"
        if all(_is_split(f.name) for f in folders):
            return "split/class"
        known = [f for f in folders if known_as(f.name, classes) is not None]
        if len(known) < len(folders):
            unknown = ", ".join(sorted(f.name for f in folders if f not in known))
            raise DataError(
                f"{self.root}: {unknown} is neither a class nor a split; the classes are "
                f"{', '.join(classes)} (`classes` of the domain), or read all files without labels "
                "with published.layout=none"
            )
        inner = [e for f in folders for e in _visible(f, self.root) if e.is_dir()]
        return "class/split" if inner and all(_is_split(e.name) for e in inner) else "class"

    def _place(self, path: Path, layout: str, classes: Sequence[str]) -> tuple[str, str]:
        """Class ("" if not known) and split of a file by its folders."""
        parts = path.relative_to(self.root).parts[:-1]
        if layout == "none":
            return "", "train"
        wanted = layout.split("/")
        if layout == "split/class" and len(parts) == 1:  # clouds without labels, in splits
            wanted = ["split"]
        if len(parts) != len(wanted):
            raise DataError(f"{path} does not lie in a folder {layout}")
        cls, split = "", "train"
        for kind, name in zip(wanted, parts, strict=True):
            if kind == "class":
                cls = class_of(name, classes, str(path))
            else:
                split = split_of(name, str(path))
        return cls, split

    def _of_file(self, path: Path, cls: str, split: str, classes: Sequence[str]) -> list[Item]:
        origin = path.relative_to(self.root).as_posix()
        if path.suffix.lower() not in _MANY:
            stem = origin.removesuffix(path.suffix) if not cls else path.stem
            row = ManifestRow(_id(cls, split, stem), cls, split, origin=origin)
            return [Item(row, str(path), functools.partial(_only, path))]
        try:
            file = read_clouds(path)
        except DataError as error:
            row = ManifestRow(_id(cls, split, path.stem), cls, split, origin=origin)
            return [Item(row, str(path), functools.partial(_raise, error))]
        if not cls and (prefix := split_prefix(path.stem)) and file.many:
            split = split_of(prefix, str(path))
        found = []
        for number, cloud in enumerate(file.clouds):
            where = f"{path}, cloud {number}" if file.many else str(path)
            own = cls or _label(file, number, classes, where)
            stem = f"{path.stem}_{number:04d}" if file.many else path.stem
            row = ManifestRow(_id(own, split, stem), own, split, origin=f"{origin}[{number}]")
            found.append(Item(row, where, functools.partial(_same, cloud)))
        return found


def _with_tests(rows: dict[str, Item], every: int) -> dict[str, Item]:
    """The last of every `every` of a class, in the order of names, goes to test."""
    by_class: dict[str, list[Item]] = {}
    for item in rows.values():
        by_class.setdefault(item.row.cls, []).append(item)
    result: dict[str, Item] = {}
    for cls, items in by_class.items():
        for number, item in enumerate(sorted(items, key=lambda i: i.row.id)):
            if number % every == every - 1:
                name = item.row.id.removeprefix(f"{cls}/train/")
                item = item._replace(row=_moved(item.row, name))
            result[item.row.id] = item
    return result


def _moved(row: ManifestRow, name: str) -> ManifestRow:
    return ManifestRow(_id(row.cls, "test", name), row.cls, "test", origin=row.origin)


def _id(cls: str, split: str, stem: str) -> str:
    return "/".join(part for part in (cls, split, stem) if part)


def _label(file: CloudFile, number: int, classes: Sequence[str], where: str) -> str:
    """The class in the file's own labels; "" if it has none."""
    if file.labels is None:
        return ""
    label: Any = file.labels[number]
    if isinstance(label, bytes):
        label = label.decode(errors="replace")
    if isinstance(label, str):
        return class_of(label, classes, where)
    if not isinstance(label, int) or not 0 <= label < len(classes):
        raise DataError(f"{where}: label {label!r} is not 0..{len(classes) - 1}")
    return classes[label]


def _is_split(name: str) -> bool:
    return name.casefold() in _SPLIT_NAMES


def _files(folder: Path, root: Path) -> Iterator[Path]:
    """All files of known formats below a folder, in order; links may not leave `root`."""
    for path in _visible(folder, root):
        if path.is_dir():
            if path.is_symlink():  # it could lead in a circle, or give the same clouds twice
                raise DataError(f"{path} is a link to a folder; move or copy the folder instead")
            yield from _files(path, root)
        elif path.suffix.lower() in SUFFIXES and path.is_file():
            yield path


def _only(path: Path) -> np.ndarray:
    file = read_clouds(path)
    if file.dropped:
        log.info("%s: %d pixels without a measurement left out", path, file.dropped)
    return file.clouds[0]


def _same(cloud: np.ndarray) -> np.ndarray:
    return cloud


def _raise(error: DataError) -> np.ndarray:
    raise error
