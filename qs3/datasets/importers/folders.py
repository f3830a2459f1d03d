"""Your own clouds: a folder of files in any format of `datasets.clouds`, with labels or without.

    class/split/name.ext     split is train, test, or val (validation)
    split/class/name.ext
    class/name.ext           every `test_every`-th of a class, sorted by name, is for test
    split/name.ext           no labels
    name.ext, any/where.ext  no labels: all of it is the split "train"

A file may hold several clouds (.npy, .npz, .h5 with an array [m, n, 3]); they are then called
name_0000, name_0001, ... If it has labels, numbers count the classes from 0 and words are names.
Such a file may have its split before its name, train_0.h5, where no folder is one; a folder that is
one decides.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import logging
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from qs3.classes import known_as
from qs3.config.checks import check_choice, check_int
from qs3.datasets.clouds.files import SUFFIXES, CloudFile, npy_clouds, parse_clouds
from qs3.datasets.clouds.finite import checked
from qs3.datasets.importers.base import (
    UP_AXES,
    Importer,
    Item,
    by_class,
    class_of,
    cloud_id,
    split_of,
    turned,
    unique,
    visible,
)
from qs3.datasets.with_depth import NOTHING, with_depth
from qs3.errors import ConfigError, DataError
from qs3.store.manifest import ManifestRow
from qs3.store.meta import MadeOf
from qs3.utils.plural import counted
from qs3.utils.text_table import printable

log = logging.getLogger(__name__)

LAYOUTS = ("auto", "class/split", "split/class", "class", "none")
_SPLIT_NAMES = ("train", "test", "val", "validation")
_SPLIT_PREFIX = re.compile(rf"({'|'.join(_SPLIT_NAMES)})(?![a-z])", re.IGNORECASE)  # train_0.h5
_MANY = (".npy", ".npz", ".h5", ".hdf5")
_ENDS = tuple(suffix.encode() for suffix in SUFFIXES)
_NUMBER = re.compile(r"\[\d+\]$")  # of the cloud in its file, at the end of an origin


@dataclass(frozen=True)
class CloudFolder(Importer):
    """See the module. Clouds may have any number of points.

    A cloud with more than P points is thinned to its P farthest (farthest point sampling from the
    first on); one with fewer repeats its points. Points without depth are left out before
    (`with_depth`). The manifest's `valid_points` says how many there were of the others.

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
        check_choice("published.layout", self.layout, LAYOUTS)
        check_choice("published.up", self.up, UP_AXES)
        check_int("published.test_every", self.test_every, 0)
        if self.test_every == 1:
            raise ConfigError("published.test_every=1 leaves nothing for training; 0 tests nothing")

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(objects=f"own clouds of {printable(self.root.name)}")

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

    def absent(self) -> str:
        """See `Importer`."""
        if self.root.is_dir():
            return f"{self.root} holds no cloud of {' '.join(SUFFIXES)}"
        return super().absent()

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`. Sorted by split, class and name.

        Raises:
            DataError: an unknown class, two files of one name, mixed layouts, clouds with and
                without labels, a damaged file of several clouds, or a link that leads out of the
                folder.
        """
        layout = self._layout(classes)
        log.info("%s is read in the layout %s", printable(str(self.root)), layout)
        last = _LastFile()
        found: list[Item] = []
        for path in _files(self.root, self.root):
            cls, split = self._place(path, layout, classes)
            stem = path.stem
            if not cls and layout == "none":  # any depth; elsewhere the folders are class or split
                stem = path.relative_to(self.root).with_suffix("").as_posix()
            found += self._of_file(path, cls, split, stem, classes, last)
        found = unique(found)
        _check_labels(found)
        if self.test_every and layout == "class":
            found = _with_tests(found, self.test_every)
        return by_class(found, classes)

    def settings(self) -> dict[str, Any]:
        """See `Importer`; with a digest of the files' names, sizes and times of change."""
        return {**super().settings(), "files": _digest(self.root)}

    def changes(self, origins: Collection[str]) -> str:
        """See `Importer`: which files are new, gone, or neither and so changed."""
        had = {_NUMBER.sub("", origin) for origin in origins}
        have = {os.fsdecode(name) for name, _, _ in _stats(self.root)}
        parts = [
            f"{len(names)} {what} ({', '.join(sorted(names)[:3])}{', ...' * (len(names) > 3)})"
            for names, what in ((have - had, "added"), (had - have, "removed"))
            if names
        ]
        return f"the files in {self.root}: {', '.join(parts) or 'some have changed'}"

    def outdated(self, manifest: Callable[[], Iterable[ManifestRow]]) -> str:
        """See `Importer`: the split of `test/train_0.npy` was once taken from its name."""
        if self.layout not in ("auto", "split/class"):
            return ""
        for row in manifest():
            folder, *inner = row.origin.split("/")
            if (
                len(inner) == 1
                and _NUMBER.search(row.origin)
                and _is_split(folder)
                and known_as(folder, [row.cls]) is None  # else it is the class: class/name.ext
                and split_of(folder, row.origin) != row.split
            ):
                return f"{row.origin} as of the split {row.split!r}, by its name and not its folder"
        return ""

    def thin(self, cloud: np.ndarray, where: str) -> np.ndarray:
        """See `Importer`: at most P points, the farthest."""
        if cloud.ndim != 2 or len(cloud) <= self.points:
            return cloud
        from qs3.geometry.sampling import farthest_point_sampling_np

        return cloud[farthest_point_sampling_np(cloud, self.points, 0)]

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        return turned(cloud, self.up)

    def _layout(self, classes: Sequence[str]) -> str:
        """The layout in the names of the folders; DataError if they fit none."""
        if self.layout != "auto":
            return self.layout
        folders = [e for e in visible(self.root, self.root) if e.is_dir()]
        folders = [f for f in folders if next(_files(f, self.root), None) is not None]
        if not folders:
            return "none"
        if all(_is_split(f.name) for f in folders):
            return "split/class"
        known = [f for f in folders if known_as(f.name, classes) is not None]
        if len(known) < len(folders):
            unknown = sorted(f.name for f in folders if f not in known)
            one = len(unknown) == 1
            are = "is neither a class nor a split" if one else "are neither classes nor splits"
            raise DataError(
                f"{self.root}: {', '.join(unknown)} {are}; the classes are "
                f"{', '.join(classes)} (`classes` of the domain), or read all files without labels "
                "with published.layout=none"
            )
        inner = [e for f in folders for e in visible(f, self.root) if e.is_dir()]
        return "class/split" if inner and all(_is_split(e.name) for e in inner) else "class"

    def _place(self, path: Path, layout: str, classes: Sequence[str]) -> tuple[str, str]:
        """Class and split of a file by its folders; each "" where they do not say."""
        parts = path.relative_to(self.root).parts[:-1]
        if layout == "none":
            return "", ""
        wanted = layout.split("/")
        if layout == "split/class" and len(parts) == 1:  # clouds without labels, in splits
            wanted = ["split"]
        if len(parts) != len(wanted):
            raise DataError(f"{path} does not lie in a folder {layout}")
        cls, split = "", "train"
        for kind, name in zip(wanted, parts, strict=True):
            if kind == "class":
                cls = class_of(name, classes, path)
            else:
                split = split_of(name, path)
        return cls, split

    def _of_file(
        self, path: Path, cls: str, split: str, stem: str, classes: Sequence[str], last: _LastFile
    ) -> list[Item]:
        """The clouds of a file; of those that may hold several only number and labels are kept."""
        origin = path.relative_to(self.root).as_posix()
        number, many, labels = 1, False, None
        numbered = path.suffix.lower() in _MANY
        try:
            if path.suffix.lower() == ".npy":
                count = npy_clouds(path)
                number, many = count or 1, count is not None
            elif numbered:
                file = last.read(path)
                number, many, labels = len(file.clouds), file.many, file.labels
        except DataError as error:
            split = split or "train"
            row = ManifestRow(cloud_id(cls, split, stem), cls, split, origin=origin)
            return [Item(row, str(path), functools.partial(_raise, error))]
        if not split:
            prefix = _SPLIT_PREFIX.match(path.stem) if many else None
            split = split_of(prefix[1].lower(), path) if prefix else "train"
        found = []
        for i in range(number):
            where = f"{path}, cloud {i}" if many else str(path)
            load: Callable[[], np.ndarray] = functools.partial(last.cloud, path, i, number, where)
            own = cls
            try:
                own = cls or _label(labels, i, classes, where)
            except DataError as error:
                load = functools.partial(_raise, error)
            name = (path.stem if own else stem) + (f"_{i:04d}" if many else "")
            place = f"{origin}[{i}]" if many else origin
            row = ManifestRow(cloud_id(own, split, name), own, split, origin=place)
            found.append(Item(row, where, load))
        return found


class _LastFile:
    """The one file that is in memory at a time."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._file = CloudFile(())

    def read(self, path: Path) -> CloudFile:
        """The file's clouds as they are, read again only if another one came between."""
        if path != self._path:
            self._path, self._file = None, CloudFile(())  # gone before the next one comes
            self._file = parse_clouds(path)
            self._path = path
        return self._file

    def cloud(self, path: Path, number: int, of: int, where: str) -> np.ndarray:
        """[n, 3] float32, without points that have no depth, and checked."""
        clouds = self.read(path).clouds
        if len(clouds) != of:
            raise DataError(f"{path} has {counted(len(clouds), 'cloud')}, a moment ago it had {of}")
        cloud, dropped = with_depth(clouds[number], where)
        if dropped:
            points = counted(dropped, "point that is", "points that are")
            log.info("%s: %s %s left out", printable(where), points, NOTHING)
        return checked(cloud, where)


def _with_tests(items: Iterable[Item], every: int) -> list[Item]:
    """The last of every `every` of a class, in the order of ids, goes to test."""
    seen: Counter[str] = Counter()
    result = []
    for item in sorted(items, key=lambda item: item.row.id):
        row = item.row
        seen[row.cls] += 1
        if seen[row.cls] % every == 0:
            id_ = cloud_id(row.cls, "test", row.id.removeprefix(f"{row.cls}/train/"))
            item = item._replace(row=dataclasses.replace(row, id=id_, split="test"))
        result.append(item)
    return result


def _label(labels: tuple[Any, ...] | None, number: int, classes: Sequence[str], where: str) -> str:
    """The class in the file's own labels; "" if it has none."""
    if labels is None:
        return ""
    label: Any = labels[number]
    if isinstance(label, bytes):
        label = label.decode(errors="replace")
    if isinstance(label, str):
        return class_of(label, classes, where)
    if not isinstance(label, int) or not 0 <= label < len(classes):
        raise DataError(f"{where}: label {label!r} is not 0..{len(classes) - 1}")
    return classes[label]


def _check_labels(items: Sequence[Item]) -> None:
    """Raise DataError if some clouds have labels and others none; not of what cannot be read."""
    known = next((item for item in items if item.row.cls), None)
    unknown = next((item for item in items if not item.row.cls and not _fails(item)), None)
    if known and unknown:
        raise DataError(
            f"{known.where} has a label ({known.row.cls}) and {unknown.where} has none: give all "
            "clouds of a folder labels, or none; what has labels can be a folder and a dataset of "
            "its own"
        )


def _fails(item: Item) -> bool:
    return getattr(item.load, "func", None) is _raise


def _is_split(name: str) -> bool:
    return name.casefold() in _SPLIT_NAMES


def _files(folder: Path, root: Path) -> Iterator[Path]:
    """All files of known formats below a folder, in order; links may not leave `root`."""
    for path in visible(folder, root):
        if path.is_dir():
            if path.is_symlink():  # it could lead in a circle, or give the same clouds twice
                raise DataError(f"{path} is a link to a folder; move or copy the folder instead")
            yield from _files(path, root)
        elif path.suffix.lower() in SUFFIXES and path.is_file():
            yield path


def _stats(root: Path) -> Iterator[tuple[bytes, int, int]]:
    """Relative name, size and time of change (ns) of what `_files` gives, in any order."""
    folders = [(os.fsencode(root), b"")]
    while folders:
        folder, prefix = folders.pop()
        try:
            with os.scandir(folder) as entries:
                for entry in entries:
                    if entry.name.startswith(b".") or entry.name == b"__MACOSX":
                        continue
                    if entry.is_dir(follow_symlinks=False):
                        folders.append((entry.path, prefix + entry.name + b"/"))
                    elif os.path.splitext(entry.name)[1].lower() in _ENDS and entry.is_file():
                        stat = entry.stat()
                        yield prefix + entry.name, stat.st_size, stat.st_mtime_ns
        except OSError as error:
            where = os.fsdecode(folder)
            raise DataError(f"{where} cannot be read ({error.strerror})") from error


def _digest(root: Path) -> str:
    """SHA-256 of `_stats`; of nothing if the folder is not there. About 5 us a file."""
    stats = sorted(_stats(root)) if root.is_dir() else []
    return hashlib.sha256(b"".join(b"%b\0%d\0%d\n" % row for row in stats)).hexdigest()


def _raise(error: DataError) -> np.ndarray:
    raise error
