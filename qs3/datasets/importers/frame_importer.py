"""Datasets of depth images: objects are cut from the frames when they are first used.

That takes minutes, so each finished frame is kept in a file of its own beside the store to come,
and an interrupted import goes on where it stopped; other settings begin anew. It is an importer and
no command of its own, since the published files are all that it needs: `domain=nyuv2` just works.
"""

from __future__ import annotations

import abc
import functools
import hashlib
import logging
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from qs3.classes import CLASSES
from qs3.config.checks import check_int
from qs3.datasets.frames.cutting import CLEAN, HARD, Piece
from qs3.datasets.frames.rules import Rules
from qs3.datasets.importers.base import Importer, Item, check_cloud
from qs3.errors import ConfigError, DataError, MissingDataError, Qs3Error
from qs3.store.manifest import OK, SPLITS, ManifestRow
from qs3.store.parts import PartFiles
from qs3.utils.plural import counted
from qs3.utils.pool import Processes
from qs3.utils.progress import progress_bar
from qs3.utils.version import VERSION

log = logging.getLogger(__name__)

COLUMNS = ("frame", "sensor", "sub", "tier", "why", "holes", "rim", "occ", "depth_m", "vertical")
"""Further columns of the manifest."""


@dataclass(frozen=True)
class FrameTask:
    """One frame to cut, before it is read.

    Attributes:
        number: in the dataset, from 1.
        split: "train" or "test".
        cluster: what is not independent of it: its room, or the block of frames it is one of.
        sensor: that took it.
        vertical: how its vertical was found.
        world_from_camera: `[3][3]` rotation to z up; None if the reader knows it.
    """

    number: int
    split: str
    cluster: str
    sensor: str
    vertical: str
    world_from_camera: Sequence[Sequence[float]] | None = None


@dataclass(frozen=True, eq=False)
class Cut:
    """One object of a frame, cut or refused.

    Attributes:
        cls, sub: its class, and its name in the dataset.
        origin: for a human.
        piece: what was cut.
    """

    cls: str
    sub: str
    origin: str
    piece: Piece


Cutter = Callable[[FrameTask], list[Cut]]


@dataclass(frozen=True)
class FrameImporter(Importer):
    """A dataset of depth images; see the module.

    Attributes:
        names: name in the dataset -> class; names that are not in it are left alone.
        rules: as `qs3.datasets.frames.rules.Rules`.
        tiers: which of "clean" and "hard" become clouds.
        block: so many frames in a row make a cluster, where rooms are not known.
        workers: processes; 0 works in this one. Their number changes no byte.
    """

    names: Mapping[str, str] = field(default_factory=dict)
    rules: Mapping[str, Any] = field(default_factory=dict)
    tiers: Sequence[str] = (CLEAN, HARD)
    block: int = 30
    workers: int = 0

    complete: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_int("published.workers", self.workers, 0)
        check_int("published.block", self.block, 1)
        if not self.tiers or not {*self.tiers} <= {CLEAN, HARD}:
            raise ConfigError(f"published.tiers={list(self.tiers)} must be some of clean, hard")
        object.__setattr__(self, "tiers", list(self.tiers))
        object.__setattr__(self, "names", dict(self.names))
        object.__setattr__(self, "rules", dict(self.rules))
        known = {"default", *CLASSES, *self.names.values()}
        if unknown := sorted({*Rules.of(self.rules).limits} - known):
            raise ConfigError(
                f"published.rules.limits names {', '.join(unknown)}, which is no class; there are "
                f"{', '.join(sorted(known))}"
            )

    @abc.abstractmethod
    def files(self) -> Mapping[str, Path]:
        """What is read at once, by a word for messages; a change of them is noticed."""

    @abc.abstractmethod
    def tasks(self) -> list[FrameTask]:
        """The frames of the official splits, in the dataset's order.

        Raises:
            DataError: a file is damaged.
        """

    @abc.abstractmethod
    def cutter(self) -> Cutter:
        """What cuts a frame; made once in each process, it may keep files open."""

    def is_there(self) -> bool:
        """See `Importer`."""
        return all(path.is_file() for path in self.files().values())

    def items(self, classes: Sequence[str]) -> list[Item]:
        """Not used: frames are cut, not listed."""
        raise NotImplementedError

    def object_of(self, id_: str) -> str:
        """See `Importer`: the room, or the block of frames; things in one room are not independent.

        It is what stands before the frame and the object's number in the last part of an id.
        """
        return id_.rsplit("/", 1)[-1].rsplit("_", 2)[0]

    def settings(self) -> dict[str, Any]:
        """See `Importer`; with a digest of the files' sizes and times of change."""
        values = super().settings()
        del values["workers"]
        digest = hashlib.sha256()
        for word, path in self.files().items():
            if path.is_file():
                stat = path.stat()
                digest.update(f"{word} {stat.st_size} {stat.st_mtime_ns}\n".encode())
        return {**values, "files": digest.hexdigest()}

    def read(
        self, classes: Sequence[str], work: Path | None = None
    ) -> tuple[list[np.ndarray], list[ManifestRow]]:
        """See `Importer`: cuts what is not cut yet, then puts all together.

        Raises:
            MissingDataError: a file is not there.
            DataError: a file is damaged, a name has no such class, or nothing was cut.
        """
        for word, path in self.files().items():
            if not path.is_file():
                raise MissingDataError(f"there is no {path} ({word})")
        if unknown := sorted({*self.names.values()} - {*classes}):
            raise DataError(
                f"published.names names {', '.join(unknown)}, but the classes are "
                f"{', '.join(classes)}"
            )
        if work is None:
            raise ConfigError("an importer of frames needs a folder to work in")
        parts = self._begun(work)
        tasks = self.tasks()
        self._cut(parts, tasks)
        found = [one for task in tasks for one in self._of_frame(parts, task)]
        label = {name: i for i, name in enumerate(classes)}
        found.sort(key=lambda f: (SPLITS.index(f[0].split), label.get(f[0].cls, -1), f[0].id))
        rows = [row for row, _ in found]
        clouds = [cloud for row, cloud in found if row.status == OK and cloud is not None]
        if not clouds:
            raise DataError(f"{self.root}: no object of {counted(len(tasks), 'frame')} can be used")
        _report(rows, self.points, self.root)
        return clouds, rows

    def _begun(self, work: Path) -> PartFiles:
        """The folder of parts: those of the same settings and versions, or none."""
        recipe = {
            "settings": self.settings(),
            "versions": {"qs3": VERSION, "numpy": np.__version__, "scipy": version("scipy")},
        }
        parts = PartFiles(work)
        if parts.have_recipe:
            try:
                parts.check(recipe)
            except Qs3Error:
                log.info("settings, files or versions have changed: the frames are cut anew")
                shutil.rmtree(work)
        parts.begin(recipe)
        return parts

    def _cut(self, parts: PartFiles, tasks: Sequence[FrameTask]) -> None:
        todo = [(_name(task), task) for task in tasks if not parts.has(_name(task))]
        if not todo:
            return
        make = functools.partial(_worker, self)
        label = f"cutting objects from {self.root.name}"
        with progress_bar(label, total=len(tasks), done=len(tasks) - len(todo)) as advance:
            for outcome in Processes(self.workers).run(make, todo):
                if outcome.result is None:
                    raise DataError(
                        f"{self.root}: the process died twice on frame {int(outcome.name)} (out of "
                        "memory, or a crash); give fewer published.workers"
                    )
                note, arrays = outcome.result
                if note["error"] and self.on_error == "stop":
                    raise DataError(note["error"])
                parts.write(outcome.name, note, arrays)
                advance()

    def _of_frame(
        self, parts: PartFiles, task: FrameTask
    ) -> Iterator[tuple[ManifestRow, np.ndarray | None]]:
        """Rows of one frame's objects with their clouds."""
        note, arrays = parts.read(_name(task))
        stem = f"{task.cluster}_{task.number:05d}"
        more = {"frame": str(task.number), "sensor": task.sensor, "vertical": task.vertical}
        if note["error"]:
            id_ = f"{task.split}/{stem}"
            yield (
                ManifestRow(id_, "", task.split, status="skipped", reason=note["error"], more=more),
                None,
            )
        for i, one in enumerate(note["objects"]):
            reason = one["reason"]
            if not reason and one["more"]["tier"] not in self.tiers:
                reason = f"{one['more']['tier']} ({one['more']['why']})"
            row = ManifestRow(
                f"{one['cls']}/{task.split}/{stem}_{i}",
                one["cls"],
                task.split,
                origin=one["origin"],
                views=1,
                valid_points=one["pixels"],
                status="skipped" if reason else OK,
                reason=reason,
                more={key: value for key in COLUMNS if (value := (more | one["more"]).get(key))},
            )
            if reason:
                yield row, None
            else:
                yield row, check_cloud(arrays[str(i)], self.points, row.id)


def _worker(
    importer: FrameImporter,
) -> Callable[[FrameTask], tuple[dict[str, Any], dict[str, np.ndarray]]]:
    """What cuts one frame and thins its objects, in whichever process."""
    cut = importer.cutter()

    def work(task: FrameTask) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        try:
            found = cut(task)
        except DataError as error:
            return {"error": str(error), "objects": []}, {}
        notes = [_note(one) for one in found]
        clouds = {
            str(i): _thinned(one.piece.points_m, importer.points)
            for i, one in enumerate(found)
            if not one.piece.refused
        }
        return {"error": "", "objects": notes}, clouds

    return work


def _thinned(points_m: np.ndarray, count: int) -> np.ndarray:
    """At most so many points, the farthest from each other."""
    from qs3.geometry.sampling import farthest_point_sampling_np

    if len(points_m) <= count:
        return points_m
    return points_m[farthest_point_sampling_np(points_m, count, 0)]


def _note(one: Cut) -> dict[str, Any]:
    piece = one.piece
    more = {"sub": one.sub}
    if not piece.refused:
        more |= {"tier": piece.tier, "why": piece.why, "depth_m": f"{piece.depth_m:.3f}"}
        more |= {key: f"{getattr(piece, key):.3f}" for key in ("holes", "rim", "occ")}
    return {
        "cls": one.cls,
        "origin": one.origin,
        "pixels": piece.pixels if piece.refused else len(piece.points_m),
        "reason": piece.why if piece.refused else "",
        "more": more,
    }


def _name(task: FrameTask) -> str:
    return f"{task.number:06d}"


def _report(rows: Sequence[ManifestRow], points: int, where: Path) -> None:
    """Log what was cut and why the rest was not: never silently."""
    cut = [row for row in rows if row.status == OK]
    tiers = Counter(row.more.get("tier", "") for row in cut)
    log.info(
        "%s: %s cut (%s)",
        where,
        counted(len(cut), "object"),
        ", ".join(f"{tier} {n}" for tier, n in sorted(tiers.items())),
    )
    if len(cut) < len(rows):
        left_out = counted(len(rows) - len(cut), "object")
        log.info("%s: %s left out; manifest.csv says why", where, left_out)
    few = sum((row.valid_points or 0) < points for row in cut)
    if few:
        have = counted(few, "object has", "objects have")
        log.info("%s: %s under %d points: some are repeated", where, have, points)
