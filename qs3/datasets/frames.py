"""Datasets of depth images: objects are cut from the frames when they are first used.

That takes minutes, so each finished frame is kept in a file of its own next to the store to come,
and an interrupted import goes on where it stopped; other settings begin anew. The readers are
`qs3.datasets.nyuv2`, `qs3.datasets.sunrgbd` and `qs3.datasets.scannet`, whose objects are fused
from many frames of a scene.
"""

import abc
import functools
import logging
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from annotated_types import Ge
from jaxtyping import Float

from qs3.datasets.cutting import Piece, Rules
from qs3.datasets.importing import Importer, Item, by_class, check_cloud, report, thinned
from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.store.meta import OK, ManifestRow
from qs3.store.parts import PartFiles
from qs3.utils.files import reading
from qs3.utils.pool import Processes
from qs3.utils.progress import progress_bar
from qs3.utils.settings import settings
from qs3.utils.version import VERSION

log = logging.getLogger(__name__)

COLUMNS = ("frame", "sensor", "sub", "tier", "why", "holes", "rim", "occ", "depth_m", "vertical")
"""Further columns of the manifest."""

Part = tuple[dict[str, Any], dict[str, np.ndarray]]
"""The note and the arrays of a finished part."""


@dataclass(frozen=True)
class FrameTask:
    """One frame, or one scene, to cut, before it is read.

    `name` is that of its part, `stem` that of its objects' ids, in which "_" parts what is not
    independent of it from the rest. `vertical` is how its vertical was found, `known` what the
    reader found out beforehand.
    """

    name: str
    stem: str
    split: str
    number: int
    sensor: str
    vertical: str
    known: Any = None


def frame_task(
    number: int, split: str, cluster: str, sensor: str, vertical: str, known: Any = None
) -> FrameTask:
    """A frame, counted from 1; `cluster` is its room, or the block of frames it is one of."""
    stem = f"{cluster}_{number:05d}"
    return FrameTask(f"{number:06d}", stem, split, number, sensor, vertical, known)


Cutter = Callable[[FrameTask], list[tuple[ManifestRow, Float[np.ndarray, "n 3"]]]]
"""The objects of a frame: class, origin and figures of each, its reason if it is left out; and its
points, float32, z up."""


@settings
class CutDataset(Importer):
    """A dataset whose objects are cut frame by frame, or scene by scene; see the module.

    Attributes:
        workers: processes; 0 works in this one. Their number changes no byte.
    """

    workers: Annotated[int, Ge(0)] = 0

    @abc.abstractmethod
    def tasks(self) -> list[FrameTask]:
        """The frames of the official splits, in the dataset's order; DataError if damaged."""

    @abc.abstractmethod
    def cutter(self) -> Cutter:
        """What cuts a frame; made once in each process, it may keep files open."""

    def items(self, classes: Sequence[str]) -> list[Item]:
        """None: frames are cut, not listed."""
        return []

    def object_of(self, id_: str) -> str:
        """See `Importer`: the room or block, before the frame's number and the object's."""
        return id_.rsplit("/", 1)[-1].rsplit("_", 2)[0]

    def watched(self) -> Iterable[Path]:
        """See `Importer`."""
        return self.files()

    def settings(self) -> dict[str, Any]:
        """See `Importer`."""
        return {key: value for key, value in super().settings().items() if key != "workers"}

    def read(
        self, classes: Sequence[str], work: Path
    ) -> tuple[list[np.ndarray], list[ManifestRow]]:
        """See `Importer`: cuts what is not cut yet, then puts all together."""
        parts, tasks = self._begun(work), self.tasks()
        todo = [(task.name, task) for task in tasks if not parts.has(task.name)]
        make = functools.partial(_worker, self)
        with progress_bar(f"cutting objects from {self.root.name}", total=len(todo)) as advance:
            for outcome in Processes(self.workers).run(make, todo) if todo else ():
                if not isinstance(outcome.result, tuple):
                    raise DataError(outcome.result or f"{outcome.name}: its process died")
                parts.write(outcome.name, *outcome.result)
                advance()
        found = []
        for task in tasks:
            note, arrays = parts.read(task.name)
            for i, one in enumerate(note["rows"]):
                load = functools.partial(arrays.__getitem__, str(i))
                found.append(Item(ManifestRow(**one), load))
        found = by_class(found, classes)
        rows = [item.row for item in found]
        report(rows, classes, self.points, self.root)
        return [item.load() for item in found if item.row.status == OK], rows

    def _begun(self, work: Path) -> PartFiles:
        """The folder of parts: those of the same settings and versions, or none."""
        versions = {
            "qs3": VERSION,
            "numpy": np.__version__,
            "opencv": cv2.__version__,
            "scipy": version("scipy"),
        }
        recipe, parts = {"settings": self.settings(), "versions": versions}, PartFiles(work)
        try:
            parts.begin(recipe)
        except (ConfigError, DataError):  # and not a full disk
            log.info("settings, files or versions have changed: the frames are cut anew")
            shutil.rmtree(work)
            parts.begin(recipe)
        return parts


@settings
class FrameDataset(CutDataset):
    """A dataset of depth images; conf/domain/nyuv2.yaml explains its settings."""

    names: dict[str, str] = field(default_factory=dict)
    rules: Rules = field(default_factory=Rules)
    tiers: list[Literal["clean", "hard"]] = field(default_factory=lambda: ["clean", "hard"])
    block: Annotated[int, Ge(1)] = 30

    def read(
        self, classes: Sequence[str], work: Path
    ) -> tuple[list[np.ndarray], list[ManifestRow]]:
        """See `Importer`."""
        limited = {*self.rules.limits} - {"default"}
        if unknown := sorted({*self.names.values(), *limited} - {*classes}):
            raise ConfigError(f"published.names or rules.limits: unknown classes {unknown}")
        return super().read(classes, work)

    def row_of(self, name: str, origin: str, piece: Piece) -> ManifestRow:
        """What was cut of a thing that the dataset calls `name`."""
        more, points, reason = {"sub": name}, len(piece.points_m), piece.why
        if piece.refused:
            points = piece.pixels
        else:
            more |= {"tier": piece.tier, "why": piece.why, "depth_m": f"{piece.depth_m:.3f}"}
            more |= {key: f"{getattr(piece, key):.3f}" for key in ("holes", "rim", "occ")}
            reason = "" if piece.tier in self.tiers else f"{piece.tier} ({piece.why})"
        row = ManifestRow("", self.names[name], "", origin=origin, views=1, reason=reason)
        return replace(row, valid_points=points, more=more)


def _worker(dataset: CutDataset) -> Callable[[FrameTask], Part | str]:
    """What cuts one frame and thins its objects, in whichever process."""
    cut = dataset.cutter()

    def work(task: FrameTask) -> Part | str:
        more = {"frame": str(task.number), "sensor": task.sensor, "vertical": task.vertical}
        rows, clouds = [], {}
        try:
            for i, (row, points) in enumerate(cut(task)):
                id_, all_ = f"{row.cls}/{task.split}/{task.stem}_{i}", {**more, **row.more}
                if not row.reason:
                    cloud = thinned(points, dataset.points)
                    clouds[str(i)] = check_cloud(cloud, dataset.points, id_)
                status = "skipped" if row.reason else OK
                kept = {key: all_[key] for key in COLUMNS if all_.get(key)}
                rows.append(replace(row, id=id_, split=task.split, status=status, more=kept))
        except Qs3Error as error:
            if dataset.on_error == "stop":
                return str(error)
            id_, clouds = f"{task.split}/{task.stem}", {}
            reason = str(error)
            rows = [ManifestRow(id_, "", task.split, status="skipped", reason=reason, more=more)]
        return {"rows": list(map(asdict, rows))}, clouds

    return work


def load_mat(path: Path) -> dict[str, Any]:
    """The variables of a MATLAB file of version 5 to 7; structs are dicts, cells are lists."""
    from scipy.io import loadmat

    with reading(path):
        found: dict[str, Any] = loadmat(path, simplify_cells=True, mat_dtype=False)
    return found
