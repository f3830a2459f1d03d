"""A folder of CAD files as a source of meshes.

Two layouts are read, each class in one of them:

    root/chair/train/chair_0001.off    the split is in the folders (ModelNet)
    root/chair/chair_0001.off          the split is made here, by a hash of class and name

Class folders may carry any name of `qs3.classes`, in any case: `night_stand` is `cabinet`.
`val`, `valid` and `validation` count as train: validation sets are cut from train later, so
that a model is selected in one way for every dataset.

Folders of other classes are left alone, so all of ModelNet40 serves as it is; `left_alone` names
them. Hidden files, `__MACOSX` and files that are not meshes are ignored. Nothing is ignored that
looks like a mesh and lies in a class where it cannot be understood: that is an error.
"""

import hashlib
import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Gt, Lt

from qs3.classes import CLASSES, known_as
from qs3.errors import ConfigError, MissingDataError
from qs3.meshes.io import SUFFIXES, Up, load_mesh
from qs3.meshes.mesh import MeshItem
from qs3.utils.settings import settings

SPLITS = ("train", "test")
SPLIT_FOLDERS = {"": "", "test": "test"} | dict.fromkeys(
    ("train", "val", "valid", "validation"), "train"
)
"""Split by the folder's name; "" of files right in the folder of their class."""
LAYOUTS = "expected class/train/name.off with class/test/name.off, or class/name.off"


@settings
class MeshFolder:
    """The meshes below one folder, with their classes and splits.

    Attributes:
        path: the root; its sub-folders are classes.
        classes: the wanted ones; None: all known. A wanted one that is not there is an error.
        test_fraction: of the meshes of a class whose folder has no splits, the part for test.
        half: "all", or "first" or "second": two disjoint halves of every class and split, so
            that a source and a target domain made from one folder share no shape.
        known: the classes of the dataset, in label order.
        keep_colliders, up: as `load_mesh`.
        optional: classes that need not be there: their objects come from elsewhere. One class at
            least must be.
    """

    path: Path
    classes: tuple[str, ...] | None = None
    test_fraction: Annotated[float, Gt(0), Lt(1)] = 0.2
    half: Literal["all", "first", "second"] = "all"
    known: tuple[str, ...] = CLASSES
    keep_colliders: bool = False
    up: Up = "z"
    optional: tuple[str, ...] = ()

    def items(self) -> list[MeshItem]:
        """The meshes, sorted by class, split and stem; no file is opened."""
        folders = self._class_folders()
        found: list[MeshItem] = []
        for cls in (name for name in self.known if name in folders):
            groups = self._groups(cls, folders[cls])
            chosen = [
                self._item(cls, split, stem, file)
                for split in SPLITS
                for stem, file in self._keep(cls, groups[split])
            ]
            if not chosen and cls not in self.optional:
                raise MissingDataError(
                    f"class {cls!r} has no mesh in {self.path} with half={self.half} ({LAYOUTS}, "
                    f"as {', '.join(SUFFIXES)}); leave it out with classes=[...]"
                )
            found.extend(chosen)
        return found

    def left_alone(self) -> list[str]:
        """Names of the folders with meshes of classes that are not wanted, or not known; sorted."""
        return [
            folder.name
            for folder in _folders(self.path)
            if known_as(folder.name, self.known) not in self._wanted and any(_meshes_below(folder))
        ]

    @property
    def _wanted(self) -> tuple[str, ...]:
        return self.classes or self.known

    def _class_folders(self) -> dict[str, list[Path]]:
        """The folders of each wanted class that is there; each has one at least."""
        folders: dict[str, list[Path]] = {}
        for folder in _folders(self.path):
            cls = known_as(folder.name, self.known)
            if cls in self._wanted:
                folders.setdefault(cls, []).append(folder)
        missing = [name for name in self._wanted if name not in folders]
        if not folders or not set(missing) <= set(self.optional):
            raise MissingDataError(
                f"{self.path} has no folder of {', '.join(missing)} ({LAYOUTS}); folders of other "
                f"names: {', '.join(self.left_alone()) or 'none'}"
            )
        return folders

    def _groups(self, cls: str, folders: Sequence[Path]) -> dict[str, dict[str, Path]]:
        """Split -> stem -> file of one class."""
        found: dict[str, dict[str, Path]] = {}
        files = [(below, file) for below in folders for file in _meshes_below(below)]
        for below, file in files:
            above = "/".join(file.relative_to(below).parts[:-1]).lower()
            if above not in SPLIT_FOLDERS:
                raise ConfigError(
                    f"{file} lies in a folder that is neither a class nor a split: {LAYOUTS}"
                )
            other = found.setdefault(SPLIT_FOLDERS[above], {}).setdefault(file.stem, file)
            if other != file:
                raise ConfigError(f"{other} and {file} are two files for one object")
        loose = found.pop("", {})
        if loose and found:
            raise ConfigError(
                f"class {cls!r} in {self.path} mixes two layouts: move all files into train and "
                "test, or none"
            )
        return self._split(cls, loose) if loose else {"train": {}, "test": {}, **found}

    def _split(self, cls: str, files: dict[str, Path]) -> dict[str, dict[str, Path]]:
        """The first `test_fraction` in the order of a hash; both splits get one if they can."""
        order = sorted(files, key=lambda stem: _hash("split", cls, stem))
        tests = int(len(order) * self.test_fraction + 0.5)
        tests = max(1, min(tests, len(order) - 1)) if len(order) > 1 else 0
        return {
            "train": {stem: files[stem] for stem in order[tests:]},
            "test": {stem: files[stem] for stem in order[:tests]},
        }

    def _keep(self, cls: str, files: dict[str, Path]) -> list[tuple[str, Path]]:
        """This half of a group, by stem; the first half gets the odd one."""
        order = sorted(files, key=lambda stem: _hash("half", cls, stem))
        middle = (len(order) + 1) // 2
        stems = {"all": order, "first": order[:middle], "second": order[middle:]}[self.half]
        return [(stem, files[stem]) for stem in sorted(stems)]

    def _item(self, cls: str, split: str, stem: str, file: Path) -> MeshItem:
        load = partial(load_mesh, file, keep_colliders=self.keep_colliders, up=self.up)
        origin = file.relative_to(self.path).as_posix()
        return MeshItem(f"{cls}/{split}/{stem}", cls, split, load, origin, file)


def classes_below(root: Path) -> list[str]:
    """What the folders with meshes are called, those of the ten by our names; sorted."""
    names = [folder.name for folder in _folders(root) if any(_meshes_below(folder))]
    return sorted({known_as(name, CLASSES) or name for name in names})


def _folders(root: Path) -> list[Path]:
    """Visible folders right below `root`, sorted; none if it is not there."""
    return sorted(path for path in root.glob("[!.]*") if path.is_dir())


def _meshes_below(folder: Path) -> Iterator[Path]:
    """Mesh files in `folder` and below it, of what is not hidden."""
    for parent, folders, names in os.walk(folder, followlinks=True):
        folders[:] = sorted(name for name in folders if not name.startswith((".", "__MACOSX")))
        for name in sorted(names):
            if Path(name).suffix.lower() in SUFFIXES and not name.startswith("."):
                yield Path(parent, name)


def _hash(purpose: str, cls: str, stem: str) -> str:
    """Order that depends on class and name only, not on where or in what format files lie."""
    return hashlib.sha256(f"{purpose}/{cls}/{stem}".encode()).hexdigest()
