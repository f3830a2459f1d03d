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

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from qs3.classes import ALIASES, CLASSES, known_as
from qs3.config.checks import check_choice, check_float
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.meshes.io import SUFFIXES, load_mesh
from qs3.meshes.source import MeshItem

SPLITS = ("train", "test")
SPLIT_FOLDERS = {
    **{"train": "train", "test": "test"},
    **dict.fromkeys(("val", "valid", "validation"), "train"),
}
HALVES = ("all", "first", "second")
LAYOUTS = "expected class/train/name.off with class/test/name.off, or class/name.off"
UNREAD = (
    *(".step", ".stp", ".iges", ".igs", ".sldprt", ".skp", ".blend", ".fbx", ".3ds", ".wrl"),
    *(".x3d", ".usd", ".usda", ".usdc", ".usdz"),
)
"""Suffixes of other formats of shapes, which somebody may think are read."""


@dataclass(frozen=True)
class MeshFolder:
    """The meshes below one folder, with their classes and splits.

    Attributes:
        path: the root; its sub-folders are classes.
        classes: the wanted ones; None: all known. A wanted one that is not there is an error,
            which names the folders that are not classes: it may be misspelt.
        test_fraction: of the meshes of a class whose folder has no splits, the part for test.
        half: "all", or "first" or "second": two disjoint halves of every class and split, so
            that a source and a target domain made from one folder share no shape.
        skip: stems of files to leave out, as if they were not there.
        known: the classes of the dataset, in label order.
        keep_colliders, up, materials: as `load_mesh`.
        optional: classes that need not be there: their objects come from elsewhere. One class at
            least must be.
    """

    path: Path
    classes: tuple[str, ...] | None = None
    test_fraction: float = 0.2
    half: str = "all"
    skip: tuple[str, ...] = ()
    known: tuple[str, ...] = CLASSES
    keep_colliders: bool = False
    up: str = "z"
    optional: tuple[str, ...] = ()
    materials: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))
        if isinstance(self.skip, str):
            raise ConfigError(f"skip must be a list of file stems, got the text {self.skip!r}")
        object.__setattr__(self, "skip", tuple(self.skip))
        if self.classes is not None:
            object.__setattr__(self, "classes", tuple(self.classes))
            unknown = [name for name in self.classes if name not in self.known]
            if unknown or not self.classes:
                raise ConfigError(f"classes must be among {', '.join(self.known)}; got {unknown}")
        check_float("test_fraction", self.test_fraction, "(0, 1)")
        check_choice("half", self.half, HALVES)

    def items(self) -> list[MeshItem]:
        """The meshes, sorted by class, split and stem; no file is opened.

        Raises:
            MissingDataError: the root, or a wanted class, is not there or has no mesh.
            ConfigError: a folder or file cannot be assigned to a class and split.
            DataError: a link leads out of the root.
        """
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
                raise ConfigError(
                    f"no mesh of class {cls!r} in {self.path} is left with half={self.half} and "
                    f"{len(self.skip)} to skip: add some, or leave it out with classes=[...]"
                )
            found.extend(chosen)
        return found

    def left_alone(self) -> list[str]:
        """Names of the folders with meshes of classes that are not wanted, or not known; sorted."""
        return [
            entry.name
            for entry in _visible(self.path)
            if entry.is_dir()
            and known_as(entry.name, self.known) not in self._wanted
            and _mesh_below(entry)
        ]

    def unread(self) -> list[str]:
        """Files of the formats of `UNREAD` in folders of wanted classes; sorted."""
        return sorted(
            self._origin(Path(parent, name))
            for folders in self._class_folders().values()
            for folder in folders
            for parent, _, names in os.walk(folder)
            for name in names
            if Path(name).suffix.lower() in UNREAD
        )

    @property
    def _wanted(self) -> tuple[str, ...]:
        return self.classes or self.known

    def _class_folders(self) -> dict[str, list[Path]]:
        """The folders of each wanted class that is there; each has one at least."""
        if not self.path.is_dir():
            raise MissingDataError(f"there is no folder of meshes at {self.path}")
        folders: dict[str, list[Path]] = {}
        for entry in _visible(self.path):
            cls = known_as(entry.name, self.known)
            if entry.is_dir() and cls in self._wanted:
                self._refuse_link_outside(entry)
                folders.setdefault(cls, []).append(entry)
        missing = [name for name in self._wanted if name not in folders]
        if not folders or not set(missing) <= set(self.optional):
            if not folders and (below := self._below()):
                raise MissingDataError(
                    f"the folders of classes are not in {self.path}, but in {below}: give that one"
                )
            there = [name for name in self.known if name in folders]
            rest = f"add them, or leave them out with classes=[{','.join(there)}]"
            others = ", ".join(map(repr, self.left_alone()))
            raise MissingDataError(
                f"{self.path} has no folder of {', '.join(missing)}: "
                + (rest if there else self._other_layout() or LAYOUTS)
                + f". Its folders of other names: {others}; known names are "
                f"{', '.join((*self.known, *self._aliases()))}" * bool(others)
            )
        return folders

    def _aliases(self) -> list[str]:
        return [name for name, cls in ALIASES.items() if cls in self.known]

    def _other_layout(self) -> str:
        """What to do where the meshes lie in a layout that people have and that is not read."""
        entries = _visible(self.path)
        if flat := next((e for e in entries if e.suffix.lower() in SUFFIXES and e.is_file()), None):
            return f"{flat.name} lies right in it; put meshes into a folder named after their class"
        for split in entries:
            if split.is_dir() and split.name.lower() in SPLIT_FOLDERS:
                for cls in _folders_in(split):
                    if known_as(cls, self.known):
                        where = f"{split.name}/{cls} to {cls}/{split.name}"
                        return f"the class comes first; move {where}"
        return ""

    def _below(self) -> Path | None:
        """The one folder in the root with folders of wanted classes, as archives unpack."""
        found = [
            folder
            for folder in _visible(self.path)
            if folder.is_dir()
            and not folder.is_symlink()
            and any(known_as(name, self.known) in self._wanted for name in _folders_in(folder))
        ]
        return found[0] if len(found) == 1 else None

    def _groups(self, cls: str, folders: Sequence[Path]) -> dict[str, dict[str, Path]]:
        """Split -> stem -> file of one class, `skip` applied."""
        given: dict[str, list[Path]] = {split: [] for split in SPLITS}
        loose: list[Path] = []
        for folder in folders:
            loose += self._mesh_files(folder, allowed=tuple(SPLIT_FOLDERS))
            for entry in _visible(folder):
                if entry.is_dir() and entry.name.lower() in SPLIT_FOLDERS:
                    self._refuse_link_outside(entry)
                    given[SPLIT_FOLDERS[entry.name.lower()]] += self._mesh_files(entry)
        if loose and any(given.values()):
            split_file = next(file for files in given.values() for file in files)
            raise ConfigError(
                f"class {cls!r} in {self.path} mixes two layouts: {self._origin(loose[0])} and "
                f"{self._origin(split_file)}. Move all files into train and test, or none"
            )
        if not loose and not any(given.values()) and cls not in self.optional:
            raise MissingDataError(
                f"class {cls!r} has no mesh in {self.path} ({LAYOUTS}, as {', '.join(SUFFIXES)}). "
                "Add some, or leave it out with classes=[...]"
            )
        if loose:
            return self._split(cls, self._by_stem(cls, loose))
        return {split: self._by_stem(cls, given[split]) for split in SPLITS}

    def _mesh_files(self, folder: Path, allowed: tuple[str, ...] = ()) -> list[Path]:
        """Mesh files right in `folder`; meshes in sub-folders that are not `allowed` raise."""
        files = []
        for entry in _visible(folder):
            if entry.is_dir():
                if entry.name.lower() not in allowed and (mesh := _mesh_below(entry)):
                    raise ConfigError(
                        f"{mesh} lies in a folder that is neither a class nor a split: {LAYOUTS}"
                    )
            elif entry.suffix.lower() in SUFFIXES:
                self._refuse_link_outside(entry)
                if not entry.name.isprintable():  # names go into manifests and messages
                    raise ConfigError(
                        f"{str(entry)!r} has unprintable characters in its name: rename it"
                    )
                if entry.is_file():
                    files.append(entry)
        return files

    def _by_stem(self, cls: str, files: Sequence[Path]) -> dict[str, Path]:
        stems: dict[str, Path] = {}
        for file in files:
            if file.stem in self.skip:
                continue
            if file.stem in stems:
                raise ConfigError(
                    f"class {cls!r} has two files for one object: "
                    f"{self._origin(stems[file.stem])} and {self._origin(file)}. "
                    "Remove or rename one of them"
                )
            stems[file.stem] = file
        return stems

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
        return MeshItem(
            id=f"{cls}/{split}/{stem}",
            cls=cls,
            split=split,
            load=partial(
                load_mesh,
                file,
                keep_colliders=self.keep_colliders,
                up=self.up,
                materials=self.materials,
            ),
            origin=self._origin(file),
            path=file,
        )

    def _origin(self, file: Path) -> str:
        return file.relative_to(self.path).as_posix()

    def _refuse_link_outside(self, entry: Path) -> None:
        if not entry.is_symlink():
            return
        try:
            target = entry.resolve(strict=True)
        except (OSError, RuntimeError) as error:
            raise DataError(f"{entry} is a broken link: remove or repair it") from error
        if not target.is_relative_to(self.path.resolve()):
            raise DataError(
                f"{entry} is a link that leads out of {self.path}, to {target}: links outside "
                "are not followed; put the file itself there"
            )


def _visible(folder: Path) -> list[Path]:
    return [
        entry
        for entry in sorted(folder.iterdir())
        if not entry.name.startswith(".") and entry.name != "__MACOSX"
    ]


def _folders_in(folder: Path) -> list[str]:
    """Their names; of a folder that cannot be read none."""
    return next(os.walk(folder), ("", [], []))[1]


def _mesh_below(folder: Path) -> Path | None:
    for parent, _, names in os.walk(folder):
        for name in names:
            if not name.startswith(".") and Path(name).suffix.lower() in SUFFIXES:
                return Path(parent, name)
    return None


def _hash(purpose: str, cls: str, stem: str) -> str:
    """Order that depends on class and name only, not on where or in what format files lie."""
    return hashlib.sha256(f"{purpose}/{cls}/{stem}".encode()).hexdigest()
