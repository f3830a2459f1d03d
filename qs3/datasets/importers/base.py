"""What all importers share: their interface, the rules for one cloud, the way into the store."""

from __future__ import annotations

import abc
import dataclasses
import functools
import logging
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from qs3.classes import ALIASES, known_as
from qs3.config.checks import check_choice, check_int
from qs3.errors import ConfigError, DataError
from qs3.store.manifest import SPLITS, ManifestRow
from qs3.store.meta import MadeOf
from qs3.store.store import is_begun, is_finished, write_pointset
from qs3.utils.locks import locked
from qs3.utils.plural import counted
from qs3.utils.progress import shown
from qs3.utils.text_table import printable

log = logging.getLogger(__name__)

_SHOWN = 5  # reasons, in the log

_UP = {
    "z": ((0, 1, 2), (1, 1, 1)),
    "-z": ((0, 1, 2), (1, -1, -1)),
    "y": ((0, 2, 1), (1, -1, 1)),
    "-y": ((0, 2, 1), (1, 1, -1)),
    "x": ((2, 1, 0), (-1, 1, 1)),
    "-x": ((2, 1, 0), (1, 1, -1)),
}
"""Axis that points up -> which columns with which signs give x y z with z up: rotations by 90°."""

UP_AXES: tuple[str, ...] = tuple(_UP)
"""What `up` may be."""


class Item(NamedTuple):
    """One published cloud before it is read: its row, as far as it is known.

    `where` names it in messages (file, or file and number); `load` gives the raw [n, 3] array or
    raises DataError. A row that knows its `valid_points` keeps them: the array is of a cloud that
    was thinned before.
    """

    row: ManifestRow
    where: str
    load: Callable[[], np.ndarray]


@dataclass(frozen=True)
class Importer(abc.ABC):
    """A published dataset on disk.

    Attributes:
        folder: where its files are.
        points: P, the points a cloud has as published. A cloud with fewer is filled up by
            repeating its points from the first on; the manifest's `valid_points` says how many
            there were. One with more is an error: it is not the dataset that was meant.
        on_error: "stop" at a damaged cloud, or "skip" it and say so in the manifest.
    """

    folder: str | Path
    points: int = 2048
    on_error: str = "stop"

    complete: ClassVar[bool] = True
    """Whether a class without clouds in a split means that something is wrong."""

    def __post_init__(self) -> None:
        if not isinstance(self.folder, str | Path):  # folder: 2024 in a file of settings
            raise ConfigError(
                f"published.folder must be the path of a folder, got {self.folder!r}; a number "
                "goes into quotes"
            )
        object.__setattr__(self, "folder", Path(os.path.expanduser(self.folder)))
        check_int("published.points", self.points, 1)
        check_choice("published.on_error", self.on_error, ("stop", "skip"))

    @property
    def root(self) -> Path:
        """The folder as an absolute path."""
        return Path(self.folder).absolute()

    @property
    def place(self) -> Path:
        """What messages about all clouds name: the folder, or the one file that holds them."""
        return self.root

    @abc.abstractmethod
    def looks_for(self) -> list[str]:
        """The files it reads, as patterns with the whole path, for a message."""

    @abc.abstractmethod
    def is_there(self) -> bool:
        """Whether there is anything to read; must be fast."""

    def absent(self) -> str:
        """Why there is nothing to read, for a message about a folder or file that was named."""
        if self.place != self.root:
            return f"there is no file {self.place}"
        if self.root.is_file():
            return f"{self.root} is a file; give the folder that it lies in"
        if not self.root.is_dir():
            return f"there is no folder {self.root}"
        return f"{self.root} holds nothing of what is looked for"

    @abc.abstractmethod
    def items(self, classes: Sequence[str]) -> list[Item]:
        """Everything there is, in the dataset's order.

        Raises:
            DataError: names the file or folder that does not fit the format.
        """

    def made_of(self) -> MadeOf:
        """What the store is made of; goes into its meta.yaml."""
        return MadeOf(objects="published files", published=True)

    def judges(self) -> str:
        """Which published clouds are for test and should be looked at once; "" of most datasets."""
        return ""

    def object_of(self, id_: str) -> str:
        """Which object a cloud shows, where its id tells; else "".

        Clouds of one object are not independent samples: `qs3.report.intervals` takes them
        together.
        """
        return ""

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """[P, 3] as published to [P, 3] with z up."""
        return cloud

    def thin(self, cloud: np.ndarray, where: str) -> np.ndarray:
        """[n, 3] as read to at most P points, for formats that allow more."""
        return cloud

    def read(
        self, classes: Sequence[str], work: Path | None = None
    ) -> tuple[list[np.ndarray], list[ManifestRow]]:
        """Read everything: [P, 3] float32 clouds with z up, and their rows and those skipped.

        Args:
            classes: the names in label order.
            work: a folder in which an importer that takes minutes may keep what it has done, to
                continue after an interruption; it is deleted when the store is finished.

        Raises:
            DataError: names the file, the line or item, and what is wrong; or one of the classes
                does not occur in a split, if the dataset is `complete`.
        """
        clouds, rows = [], []
        for row, where, load in shown(self.items(classes), f"importing {self.place.name}"):
            try:
                raw = load()
                cloud = check_cloud(self.thin(raw, where), self.points, where)
            except DataError as error:
                if self.on_error == "stop":
                    raise
                rows.append(dataclasses.replace(row, status="skipped", reason=str(error)))
                continue
            clouds.append(self.turn(cloud, row.cls))
            measured = len(raw) if row.valid_points is None else row.valid_points
            rows.append(dataclasses.replace(row, valid_points=measured))
        _check_complete(rows, classes, self.place, strict=self.complete)
        _report(rows, self.points, self.place)
        return clouds, rows

    def settings(self) -> dict[str, Any]:
        """Plain values that decide what `read` gives; kept in the store's meta.yaml."""
        values = dataclasses.asdict(self)
        values["folder"] = printable(str(self.root))  # YAML holds no broken characters
        return {"format": type(self).__name__, **values}

    def changes(self, origins: Collection[str]) -> str:
        """How the files differ from an import of other "files"; `origins` of its manifest."""
        return f"the files in {self.root}"

    def outdated(self, manifest: Callable[[], Iterable[ManifestRow]]) -> str:
        """What an earlier version of qs3 read otherwise of the same files; "" if nothing.

        `manifest` reads the rows of the store, which takes its time where there are many.
        """
        return ""


def import_into(folder: Path, importer: Importer, *, name: str, classes: Sequence[str]) -> None:
    """Read the published files and put the finished store at `folder`, all or nothing.

    Several processes may ask at once (a sweep): one imports, the others wait and find it done.
    The store is built next to `folder` and renamed, so a kill leaves nothing at `folder`.

    Raises:
        DataError: damaged files, or `folder` holds something else.
    """
    folder = folder.absolute()
    building = folder.with_name(f".{folder.name}.importing")
    with locked(folder.with_name(f".{folder.name}.lock")):
        if is_finished(folder):
            return
        if is_begun(folder):
            raise DataError(
                f"{folder} holds a generation that was not finished, and {importer.root} holds "
                "published files: continue the generation with its command, or delete the folder "
                "to import the published files"
            )
        shutil.rmtree(building, ignore_errors=True)
        work = folder.with_name(f".{folder.name}.parts")
        settings = importer.settings()
        clouds, rows = importer.read(classes, work)
        if importer.settings() != settings:
            raise DataError(
                f"files in {importer.root} were added, removed or changed while they were "
                "imported; run the same command again when nothing writes there"
            )
        write_pointset(
            building,
            name=name,
            classes=classes,
            arrays={"points": clouds},
            rows=rows,
            meta={"imported": settings, **importer.made_of().meta},
        )
        if folder.is_dir():  # holds a lock at most
            shutil.rmtree(folder)
        os.rename(building, folder)
        shutil.rmtree(work, ignore_errors=True)


def cloud_id(cls: str, split: str, name: str) -> str:
    """An id: class, split and name, as far as they are known."""
    return "/".join(part for part in (cls, split, name) if part)


def file_item(
    path: Path, root: Path, cls: str, split: str, load: Callable[[Path], np.ndarray], name: str = ""
) -> Item:
    """The one cloud of a file below `root`; its name is that of the file unless given."""
    id_ = cloud_id(cls, split, name or path.stem)
    row = ManifestRow(id_, cls, split, origin=path.relative_to(root).as_posix())
    return Item(row, str(path), functools.partial(load, path))


def unique(items: Iterable[Item]) -> list[Item]:
    """The items themselves, if their ids differ by more than case: not all systems tell it.

    Raises:
        DataError: names two files of one id.
    """
    found: dict[str, Item] = {}
    for item in items:
        other = found.setdefault(item.row.id.casefold(), item)
        if other is not item:
            raise DataError(f"{item.where} and {other.where} have one name; rename one")
    return list(found.values())


def by_class(items: Iterable[Item], classes: Sequence[str]) -> list[Item]:
    """Sorted by split, class (none before all) and id."""
    label = {name: i for i, name in enumerate(classes)}
    return sorted(
        items, key=lambda i: (SPLITS.index(i.row.split), label.get(i.row.cls, -1), i.row.id)
    )


def class_of(name: str, classes: Sequence[str], where: str | Path) -> str:
    """The class that a name means, in any case (`qs3.classes.ALIASES`); DataError if none."""
    found = known_as(name, classes)
    if found is None:
        raise DataError(
            f"{where}: unknown class {name!r}; known are {', '.join(classes)} "
            f"and the other names {', '.join(sorted(ALIASES))}"
        )
    return found


def split_of(name: str, where: str | Path) -> str:
    """The split that a published name means; DataError if none."""
    splits = {"train": "train", "test": "test", "validation": "validation", "val": "validation"}
    if name.casefold() not in splits:
        raise DataError(f"{where}: unknown split {name!r}; known are {', '.join(splits)}")
    return splits[name.casefold()]


def inside(path: Path, root: Path) -> Path:
    """The path itself; DataError if it is a link out of `root` (an unpacked archive's trick)."""
    if path.is_symlink() and not path.resolve().is_relative_to(root.resolve()):
        raise DataError(f"{path} is a link that leads out of {root}; copy the files instead")
    return path


def visible(folder: Path, root: Path) -> list[Path]:
    """What is in a folder in order of its names, hidden things left out.

    Raises:
        DataError: it cannot be read, a name is not printable text, or a link leads out of `root`.
    """
    try:
        names = sorted(os.listdir(folder))
    except OSError as error:
        raise DataError(f"{folder} cannot be read ({error.strerror})") from error
    clear = [name for name in names if not name.startswith(".") and name != "__MACOSX"]
    for name in clear:
        if not name.isprintable():
            raise DataError(
                f"{folder / name!r}: a name with control or broken characters; rename it"
            )
    return [inside(folder / name, root) for name in clear]


def folders_in(folder: Path, root: Path) -> Iterator[Path]:
    """The visible folders in one, in order; see `visible`."""
    return (path for path in visible(folder, root) if path.is_dir())


def files_in(folder: Path, root: Path, suffix: str) -> Iterator[Path]:
    """The visible files with this extension, in any case; see `visible`."""
    return (p for p in visible(folder, root) if p.suffix.lower() == suffix and p.is_file())


def check_cloud(cloud: np.ndarray, points: int, where: str) -> np.ndarray:
    """[P, 3] float32 from [n, 3] with 1 <= n <= P, filled up by repeating from the first point.

    Raises:
        DataError: wrong shape, no points, more than P, or a value that is not finite.
    """
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise DataError(f"{where}: the array has shape {cloud.shape}, expected [{points}, 3]")
    if not 1 <= len(cloud) <= points:
        raise DataError(
            f"{where}: the cloud has {len(cloud)} points, expected 1 to {points}; if the dataset "
            "was published with another number, set `points` of the importer to it"
        )
    with np.errstate(over="ignore"):  # becomes infinite, and is reported as such
        cloud = np.asarray(cloud, dtype=np.float32)
    if not (finite := np.isfinite(cloud).all(axis=1)).all():
        row = int(np.flatnonzero(~finite)[0])
        raise DataError(f"{where}, point {row + 1}: {cloud[row].tolist()} is not finite")
    return cloud if len(cloud) == points else cloud[np.arange(points) % len(cloud)]


def turned(cloud: np.ndarray, up: str) -> np.ndarray:
    """[..., 3] of which the axis `up` of `UP_AXES` points up, turned by 90 degrees to z up."""
    columns, signs = _UP[up]
    return cloud[..., columns] * np.array(signs, dtype=cloud.dtype)


def _check_complete(
    rows: Iterable[ManifestRow], classes: Sequence[str], where: Path, *, strict: bool
) -> None:
    """Raise DataError (or warn) if a class has no cloud in a split that other classes have."""
    have = {(row.split, row.cls) for row in rows if row.status == "ok"}
    if not have:
        reasons = [row.reason for row in rows if row.status != "ok"]
        raise DataError(f"{where} holds no clouds" + _why(reasons))
    if not any(cls for _, cls in have):
        return  # no labels at all
    for split in sorted({split for split, _ in have}):
        if empty := [name for name in classes if (split, name) not in have]:
            problem = f"{where}: split {split!r} has no clouds of {', '.join(empty)}"
            if strict:
                raise DataError(problem)
            log.warning("%s", printable(problem))


def _why(reasons: Sequence[str]) -> str:
    """What was wrong with the clouds that were left out, of a dataset where all were."""
    if not reasons:
        return ""
    lines = [f"  {reason}" for reason in reasons[:_SHOWN]]
    lines += [f"  and {len(reasons) - _SHOWN} more"] * (len(reasons) > _SHOWN)
    return "\n".join([f" that can be read; {counted(len(reasons), 'is', 'are')} damaged:", *lines])


def _report(rows: Sequence[ManifestRow], points: int, where: Path) -> None:
    """Log how many clouds were filled up and how many left out: never silently."""
    short = sum(row.valid_points is not None and row.valid_points < points for row in rows)
    skipped = sum(row.status != "ok" for row in rows)
    if short:
        have = counted(short, "cloud has", "clouds have")
        name = printable(str(where))
        log.warning("%s: %s under %d points: some are repeated", name, have, points)
    if skipped:
        for row in [row for row in rows if row.status != "ok"][:_SHOWN]:
            log.warning("left out: %s", printable(row.reason))
        left = counted(skipped, "cloud")
        log.warning("%s: %s left out; manifest.csv says why", printable(str(where)), left)
