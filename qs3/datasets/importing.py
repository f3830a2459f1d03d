"""Published formats, read once into the store: what all importers share.

An importer is a frozen dataclass (named by `_target_` in conf/domain) that knows where its files
are and reads them to clouds and manifest rows. Clouds keep their published scale and order;
only the axes are turned so that z is up.
"""

import abc
import dataclasses
import functools
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from annotated_types import Ge
from jaxtyping import Float

from qs3.classes import known_as
from qs3.errors import DataError
from qs3.store.meta import SPLITS, MadeOf, ManifestRow, is_begun, is_finished
from qs3.store.store import write_pointset
from qs3.utils.files import locked
from qs3.utils.progress import shown
from qs3.utils.settings import settings

log = logging.getLogger(__name__)

UpAxis = Literal["z", "-z", "y", "-y", "x", "-x"]
UP_AXES: tuple[str, ...] = get_args(UpAxis)
"""The axes of a file that may point up."""

_TURNS = {
    "z": ((0, 1, 2), (1, 1, 1)),
    "-z": ((0, 1, 2), (1, -1, -1)),
    "y": ((0, 2, 1), (1, -1, 1)),
    "-y": ((0, 2, 1), (1, 1, -1)),
    "x": ((2, 1, 0), (-1, 1, 1)),
    "-x": ((2, 1, 0), (1, 1, -1)),
}
"""Axis that points up -> which columns with which signs give x y z with z up: rotations by 90°."""


class Item(NamedTuple):
    """One published cloud before it is read: its row, as far as it is known.

    `load` gives the raw [n, 3] array or raises DataError. A row that knows its `valid_points` keeps
    them: the array is of a cloud that was thinned before.
    """

    row: ManifestRow
    load: Callable[[], np.ndarray]


@settings
class Importer(abc.ABC):
    """A published dataset on disk.

    Attributes:
        folder: where its files are.
        points: P, the points a cloud has as published. One with fewer repeats its points from the
            first on; the manifest's `valid_points` has how many there were.
        on_error: "stop" at a damaged cloud, or "skip" it with the reason in the manifest.
    """

    folder: Path
    points: Annotated[int, Ge(1)] = 2048
    on_error: Literal["stop", "skip"] = "stop"

    recorded: ClassVar[str] = "imported"
    """The key of the settings in the store's meta.yaml."""

    made: ClassVar[MadeOf] = MadeOf(objects="published files", published=True)
    """What the store is made of, where it does not depend on the settings."""

    holds: ClassVar[str] = ""
    """A pattern of what is read, below the folder, where `files` does not name it."""

    thins: ClassVar[bool] = False
    """Whether larger clouds become their farthest points; else they are an error."""

    @property
    def root(self) -> Path:
        """The folder as an absolute path."""
        return Path(os.path.expanduser(self.folder)).absolute()

    def files(self) -> Sequence[Path]:
        """The files that are read, all of which must be there."""
        return ()

    def is_there(self) -> bool:
        """Whether there is anything to read; must be fast."""
        files = self.files()
        if files or not self.holds:
            return bool(files) and all(map(Path.is_file, files))
        return any(self.root.glob(self.holds))

    @abc.abstractmethod
    def items(self, classes: Sequence[str]) -> list[Item]:
        """Everything there is, in the dataset's order."""

    def made_of(self) -> MadeOf:
        """What the store is made of; goes into its meta.yaml."""
        return self.made

    def object_of(self, id_: str) -> str:
        """Which object a cloud shows, where its id shows it; else "".

        `qs3.report.intervals` takes clouds of one object together: they are not independent.
        """
        return ""

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """[P, 3] as published, with the axis `up` of the importer up, to [P, 3] with z up."""
        return turned(cloud, getattr(self, "up", "z"))

    def read(
        self, classes: Sequence[str], work: Path
    ) -> tuple[list[np.ndarray], list[ManifestRow]]:
        """Read everything: [P, 3] float32 clouds with z up, and their rows and those skipped.

        In the folder `work` an importer that takes minutes may keep what it has done, to go on
        after an interruption; it is deleted when the store is finished.
        """
        clouds, rows = [], []
        for row, load in shown(self.items(classes), f"importing {self.root.name}"):
            try:
                raw = load()
                cloud = thinned(raw, self.points) if self.thins else raw
                cloud = check_cloud(cloud, self.points, f"{self.root}/{row.origin}")
            except DataError as error:
                if self.on_error == "stop":
                    raise
                rows.append(dataclasses.replace(row, status="skipped", reason=str(error)))
                continue
            clouds.append(self.turn(cloud, row.cls))
            measured = len(raw) if row.valid_points is None else row.valid_points
            rows.append(dataclasses.replace(row, valid_points=measured))
        report(rows, classes, self.points, self.root)
        return clouds, rows

    def watched(self) -> Iterable[Path]:
        """Files that are noticed to have changed after an import, by their sizes and times."""
        return ()

    def settings(self) -> dict[str, Any]:
        """Plain values that decide what `read` gives; kept in the store's meta.yaml."""
        values = {"format": type(self).__name__, **dataclasses.asdict(self)}
        plain: dict[str, Any] = json.loads(json.dumps({**values, "folder": str(self.root)}))
        seen = [
            (os.path.relpath(path, self.root), path.stat().st_size, path.stat().st_mtime_ns)
            for path in self.watched()
            if path.is_file()
        ]
        if seen:
            plain["files"] = hashlib.sha256(repr(seen).encode()).hexdigest()
        return plain


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
                f"{folder} holds an unfinished generation: finish it, or delete the folder"
            )
        shutil.rmtree(building, ignore_errors=True)
        work = folder.with_name(f".{folder.name}.parts")
        settings = importer.settings()
        clouds, rows = importer.read(classes, work)
        if importer.settings() != settings:
            raise DataError(f"files in {importer.root} changed while they were imported")
        write_pointset(
            building,
            name=name,
            classes=classes,
            arrays={"points": clouds},
            rows=rows,
            meta={importer.recorded: settings, **importer.made_of().meta},
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
    return Item(row, functools.partial(load, path))


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
        raise DataError(f"{where}: unknown class {name!r}; known are {', '.join(classes)}")
    return found


def split_of(name: str, where: str | Path) -> str:
    """The split that a published name means; DataError if none."""
    split = "validation" if name.casefold() == "val" else name.casefold()
    if split not in SPLITS:
        raise DataError(f"{where}: unknown split {name!r}; known are {', '.join(SPLITS)}")
    return split


def check_cloud(cloud: np.ndarray, points: int, where: str) -> Float[np.ndarray, "P 3"]:
    """[P, 3] float32 from [n, 3] with 1 <= n <= P, filled up by repeating from the first point."""
    if cloud.ndim != 2 or cloud.shape[1] != 3 or not 1 <= len(cloud) <= points:
        raise DataError(f"{where}: shape {cloud.shape}, expected 1 to {points} points x y z")
    with np.errstate(over="ignore"):  # becomes infinite
        cloud = np.asarray(cloud, dtype=np.float32)
    if not (finite := np.isfinite(cloud).all(axis=1)).all():
        raise DataError(f"{where}, point {int(np.argmin(finite)) + 1} is not finite")
    return cloud if len(cloud) == points else cloud[np.arange(points) % len(cloud)]


def thinned(cloud: Float[np.ndarray, "n 3"], points: int) -> Float[np.ndarray, "m 3"]:
    """At most so many points, the farthest from each other, from the first on."""
    from qs3.geometry.sampling import farthest_point_sampling_np

    if len(cloud) <= points:
        return cloud
    return cloud[farthest_point_sampling_np(cloud, points, 0)]


def turned(cloud: Float[np.ndarray, "*b 3"], up: str) -> Float[np.ndarray, "*b 3"]:
    """[..., 3] of which the axis `up` of `UP_AXES` points up, turned by 90 degrees to z up."""
    columns, signs = _TURNS[up]
    return cloud[..., columns] * np.array(signs, dtype=cloud.dtype)


def report(rows: Sequence[ManifestRow], classes: Sequence[str], points: int, where: Path) -> None:
    """Warn of what is missing, filled up or left out. DataError if nothing is there."""
    kept = [row for row in rows if row.status == "ok"]
    if not kept:
        raise DataError(f"{where} holds no clouds that can be read")
    for split in sorted({row.split for row in kept if row.cls}):
        have = {row.cls for row in kept if row.split == split}
        if empty := [name for name in classes if name not in have]:
            log.warning("%s: split %r has no clouds of %s", where, split, ", ".join(empty))
    if short := sum((row.valid_points or points) < points for row in kept):
        log.warning("%s: clouds under %d points, some repeated: %d", where, points, short)
    if len(kept) < len(rows):
        text = "%s: clouds left out: %d; manifest.csv says why"
        log.warning(text, where, len(rows) - len(kept))
