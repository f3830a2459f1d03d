"""Folders of one file a cloud, `<class>/<split>/<name>.xyz` or `.npy`.

SpeckleNet10 and DepthScanNet10 are published as .xyz (text, 2048 rows of x y z), PointDA-10's
ModelNet10 and ShapeNet10 as .npy ([2048, 3] and [1024, 3]).
"""

from __future__ import annotations

import abc
import functools
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from qs3.data.importers.base import (
    Importer,
    Item,
    class_of,
    inside,
    split_of,
    y_up_to_z_up,
)
from qs3.data.manifest import SPLITS, ManifestRow
from qs3.errors import ConfigError, DataError

_SCANNET = re.compile(r"/(scene\d{4})_\d{2}(?:_|$)")
_MAX_BYTES = 64 << 20  # of one cloud's file; a published one has under 200 kB


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

    @abc.abstractmethod
    def read_file(self, path: Path) -> np.ndarray:
        """[n, 3] coordinates as they are in one file."""

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        return [f"{self.root}/<class>/{{train,test}}/*{self.suffix}"]

    def is_there(self) -> bool:
        """See `Importer`: whether the folder has a subfolder."""
        return self.root.is_dir() and any(e.is_dir() for e in _visible(self.root, self.root))

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`."""
        return [
            Item(
                ManifestRow(e.id, e.cls, e.split, origin=str(e.path.relative_to(self.root))),
                str(e.path),
                functools.partial(self.read_file, e.path),
            )
            for e in list_tree(self.root, self.suffix, classes)
        ]

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        return y_up_to_z_up(cloud) if self.up == "y" and cls not in self.up_z_classes else cloud


@dataclass(frozen=True)
class XyzTree(TreeImporter):
    """Text files: a row a point, three numbers separated by blanks."""

    suffix: ClassVar[str] = ".xyz"

    def read_file(self, path: Path) -> np.ndarray:
        """See `TreeImporter`."""
        return read_xyz(path)

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

    def read_file(self, path: Path) -> np.ndarray:
        """See `TreeImporter`."""
        return read_npy(path)


def read_xyz(path: Path) -> np.ndarray:
    """[n, 3] float64 from a text file of n rows with three numbers.

    Raises:
        DataError: names the line.
    """
    data = _bytes_of(path)
    if not data.strip():
        raise DataError(f"{path}: the file is blank")
    try:
        text = data.decode()
        cloud = np.loadtxt(text.splitlines(), dtype=np.float64, ndmin=2, comments=None)
    except (ValueError, UnicodeDecodeError):
        cloud = None
    if cloud is None or cloud.shape[1] != 3:
        raise DataError(_first_bad_line(path, data))
    return cloud


def read_npy(path: Path) -> np.ndarray:
    """The array of a .npy file of real numbers.

    Raises:
        DataError: pickled, truncated, or not an .npy file.
    """
    size = len(_bytes_of(path))
    try:
        with open(path, "rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a header written by Python 2
            version = np.lib.format.read_magic(file)
            read = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }.get(version)
            if read is None:
                raise ValueError(f"version {version} of the .npy format")
            shape, _, dtype = read(file)
            if dtype.hasobject:
                raise DataError(f"{path}: a pickled array, refused; save it as plain numbers")
            if dtype.kind not in "fiu":
                raise DataError(f"{path}: the array holds {dtype}, not numbers")
            expected = file.tell() + dtype.itemsize * int(np.prod(shape, dtype=np.int64))
            if size != expected:
                raise DataError(f"{path}: {size} bytes, expected {expected} for shape {shape}")
            file.seek(0)
            return np.load(file, allow_pickle=False)
    except DataError:
        raise
    except Exception as error:  # numpy's parser of headers raises a dozen kinds
        raise DataError(f"{path}: not a readable .npy file ({error})") from error


def list_tree(root: Path, suffix: str, classes: Sequence[str]) -> list[Entry]:
    """All clouds of `root/<class>/<split>/*suffix`, in the order of `TreeImporter`.

    Hidden files and other extensions are passed over.

    Raises:
        DataError: unknown class or split, two folders of one class, two files of one name, a
            name that is not UTF-8, or a link that leads out of `root`.
    """
    entries: dict[str, Entry] = {}
    folders: dict[tuple[str, str], Path] = {}
    for class_folder in (e for e in _visible(root, root) if e.is_dir()):
        cls = class_of(class_folder.name, classes, str(root))
        for split_folder in (e for e in _visible(class_folder, root) if e.is_dir()):
            split = split_of(split_folder.name, str(class_folder))
            if (cls, split) in folders:
                raise DataError(f"{split_folder} and {folders[cls, split]} are the same class")
            folders[cls, split] = split_folder
            for path in _visible(split_folder, root):
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


def _visible(folder: Path, root: Path) -> list[Path]:
    """What is in a folder, hidden things left out, after checking that it stays inside `root`."""
    found = []
    try:
        names = sorted(os.listdir(folder))
    except OSError as error:
        raise DataError(f"{folder} cannot be read ({error.strerror})") from error
    for name in names:
        if name.startswith(".") or name == "__MACOSX":
            continue
        path = folder / name
        try:
            name.encode()
        except UnicodeEncodeError:
            raise DataError(f"{path!r}: the name is not UTF-8; rename it") from None
        found.append(inside(path, root))
    return found


def _bytes_of(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        if not 0 < size <= _MAX_BYTES:
            raise DataError(f"{path}: {size} bytes, expected 1 to {_MAX_BYTES}")
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror})") from error


def _first_bad_line(path: Path, data: bytes) -> str:
    """Where and why a text file is not rows of three numbers."""
    for number, line in enumerate(data.split(b"\n"), start=1):
        words = line.split()
        if not words:
            continue
        try:
            [float(word) for word in words]
            if len(words) == 3:
                continue
        except ValueError:
            pass
        shown = line[:60].decode(errors="replace").strip()
        return f"{path}, line {number}: {shown!r} is not three numbers"
    return f"{path}: not a text file of rows with three numbers"
