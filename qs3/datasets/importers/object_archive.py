"""An archive of objects that were cut from depth images, in one .npz: clouds of any size.

    xyz_tenth_mm   [P, 3] int16   points of all objects, in tenths of a millimetre about `centre_m`
    centre_m       [N, 3] float   z up, the camera at the origin
    start          [N + 1] int    object i has the points start[i] to start[i + 1]
    cls            [N] text       class
    tier           [N] text       "clean" or "hard"
    img            [N] int        number of the frame it was cut from
    inlier         [P] bool       optional: false for stray points
    sub            [N] text       optional: finer name
    dev            [N] text       optional: which part of a development split it is of
    pixels         [N] int        optional: pixels with depth that it was cut from
    rim, occ       [N] float      optional: share of its outline that the picture cuts off, and that
                                  something nearer covers

Frames in a row show one room: objects of one block of frames are not independent, and a part of the
archive that judges is blocks away from one that is trained on.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import zipfile
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from qs3.config.checks import check_bool, check_int, check_words
from qs3.datasets.importers.arrays import plain_arrays
from qs3.datasets.importers.base import Importer, Item, class_of
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.store.manifest import SPLITS, ManifestRow
from qs3.store.meta import MadeOf
from qs3.utils.plural import counted
from qs3.utils.text_table import printable

log = logging.getLogger(__name__)

TIERS = ("clean", "hard")
ADAPT, JUDGE = "adapt", "judge"
"""Parts of an archive's `dev`: what one trains and chooses on, and what is looked at once."""

_METRES = 1e-4
_KINDS = {
    "xyz_tenth_mm": ("i", "[P, 3] of int16"),
    "centre_m": ("f", "[N, 3] of numbers"),
    "start": ("iu", "[N + 1] of whole numbers"),
    "cls": ("U", "[N] of text"),
    "tier": ("U", "[N] of text"),
    "img": ("iu", "[N] of whole numbers"),
    "inlier": ("b", "[P] of bool"),
    "sub": ("U", "[N] of text"),
    "dev": ("U", "[N] of text"),
    "pixels": ("iu", "[N] of whole numbers"),
    "rim": ("f", "[N] of numbers"),
    "occ": ("f", "[N] of numbers"),
}
_OPTIONAL = ("inlier", "sub", "dev", "pixels", "rim", "occ")
_REQUIRED = tuple(key for key in _KINDS if key not in _OPTIONAL)


@dataclass(frozen=True, eq=False)
class Archive:
    """What the file holds, checked.

    Attributes:
        path: of the file.
        cls, sub, tier, dev: [N] text; `sub` is `cls` and `dev` empty where the file has none.
        frame: [N] number of the frame.
        pixels, rim, occ: [N]; None where the file has none.
    """

    path: Path
    cls: np.ndarray
    sub: np.ndarray
    tier: np.ndarray
    dev: np.ndarray
    frame: np.ndarray
    pixels: np.ndarray | None
    rim: np.ndarray | None
    occ: np.ndarray | None
    _tenths: np.ndarray
    _centre: np.ndarray
    _start: np.ndarray
    _inlier: np.ndarray | None

    def __len__(self) -> int:
        """N."""
        return len(self.cls)

    @property
    def parts(self) -> dict[str, int]:
        """Objects of each part of `dev`, by name."""
        return dict(sorted(Counter(self.dev[self.dev != ""].tolist()).items()))

    def of_part(self, part: str) -> list[int]:
        """Positions of the objects of a part.

        Raises:
            ConfigError: there is none of that name.
        """
        if part not in self.parts:
            has = f"its parts are {', '.join(self.parts)}" if self.parts else "it has no parts"
            raise ConfigError(f"part={part}: {self.path} has none of that name; {has}")
        return np.flatnonzero(self.dev == part).tolist()

    def size(self, index: int) -> int:
        """Points of an object, stray ones too."""
        return int(self._start[index + 1] - self._start[index])

    def cloud(self, index: int, inliers_only: bool) -> np.ndarray:
        """[n, 3] float32 metres, z up, the camera at the origin."""
        part = slice(self._start[index], self._start[index + 1])
        xyz = self._tenths[part] * _METRES + self._centre[index].astype(np.float64)
        if inliers_only and self._inlier is not None:
            kept = self._inlier[part]
            xyz = xyz[kept] if kept.any() else xyz
        return np.asarray(xyz, dtype=np.float32)


@dataclass(frozen=True)
class ObjectArchive(Importer):
    """See the module.

    Attributes:
        file: the .npz, in the folder or by its whole path.
        train_parts, test_parts: values of `dev` that are for training and for test; others are
            left out. An archive without `dev` is all for test.
        fold, folds: instead, `train_parts` alone, cut into `folds` runs of blocks, of which number
            `fold` (from 0) is for test and the others for training.
        gap: frames next to a fold's test blocks that are left out of its training part.
        block: so many frames in a row make a cluster.
        inliers_only: leave stray points out.
        tiers: which of "clean" and "hard".
    """

    file: str = "objects.npz"
    train_parts: Sequence[str] = (ADAPT,)
    test_parts: Sequence[str] = (JUDGE,)
    fold: int | None = None
    folds: int = 5
    gap: int = 15
    block: int = 30
    inliers_only: bool = True
    tiers: Sequence[str] = TIERS

    complete: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("train_parts", "test_parts", "tiers"):
            words = check_words(f"published.{key}", getattr(self, key))
            object.__setattr__(self, key, words)
        check_bool("published.inliers_only", self.inliers_only)
        for key, least in (("folds", 2), ("gap", 0), ("block", 1)):
            check_int(f"published.{key}", getattr(self, key), least)
        if self.fold is not None and check_int("published.fold", self.fold, 0) >= self.folds:
            raise ConfigError(f"published.fold={self.fold} of {self.folds} folds counted from 0")
        if both := sorted({*self.train_parts} & {*self.test_parts}):
            raise ConfigError(f"published.train_parts and test_parts both name {', '.join(both)}")
        if not self.tiers or not {*self.tiers} <= {*TIERS}:
            raise ConfigError(f"published.tiers={self.tiers} must be some of {', '.join(TIERS)}")

    @property
    def path(self) -> Path:
        """Where the .npz lies."""
        return self.root / Path(self.file).expanduser()

    @property
    def place(self) -> Path:
        """See `Importer`."""
        return self.path

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(
            objects=f"real objects cut from depth images, archive {printable(self.path.name)}"
        )

    def judges(self) -> str:
        """See `Importer`."""
        if self.fold is not None:
            return ""
        parts = ", ".join(self.test_parts)
        return f"part {parts} of {self.path.name} (all of it, if it has no parts)"

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        return [f"{self.path}   (arrays {', '.join(_REQUIRED)}; published.file=PATH)"]

    def is_there(self) -> bool:
        """See `Importer`."""
        return self.path.is_file()

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`; reads the file. Sorted by split, class and id."""
        archive = read_archive(self.path)
        splits = self._splits(archive)
        found, left = [], Counter[str]()
        for i in range(len(archive)):
            where = f"{archive.path}, object {i}"
            cls = class_of(str(archive.cls[i]), classes, where)
            split = splits[i]
            if not split or archive.tier[i] not in self.tiers:
                left[str(archive.dev[i]) if not split else str(archive.tier[i])] += 1
                continue
            frame = int(archive.frame[i])
            name = f"{cluster(frame, self.block)}_{frame:05d}_{i}"
            more = {"frame": str(frame), "sub": str(archive.sub[i]), "tier": str(archive.tier[i])}
            row = ManifestRow(
                f"{cls}/{split}/{name}",
                cls,
                split,
                origin=f"{printable(self.path.name)}[{i}]",
                views=1,
                more=more,
            )
            load = functools.partial(archive.cloud, i, self.inliers_only)
            found.append(Item(row, where, load))
        if left:
            counts = ", ".join(f"{name or 'in no part'} {n}" for name, n in sorted(left.items()))
            log.info("%s: objects left out: %s", self.path, counts)
        return sorted(
            found, key=lambda f: (SPLITS.index(f.row.split), classes.index(f.row.cls), f.row.id)
        )

    def object_of(self, id_: str) -> str:
        """See `Importer`: the block of frames."""
        return id_.rsplit("/", 1)[-1].rsplit("_", 2)[0]

    def thin(self, cloud: np.ndarray, where: str) -> np.ndarray:
        """See `Importer`: at most P points, the farthest."""
        if len(cloud) <= self.points:
            return cloud
        from qs3.geometry.sampling import farthest_point_sampling_np

        return cloud[farthest_point_sampling_np(cloud, self.points, 0)]

    def settings(self) -> dict[str, Any]:
        """See `Importer`; the file by what it holds: a copy of it elsewhere is the same archive."""
        values = super().settings()
        del values["folder"], values["file"]
        return {**values, "files": _contents(self.path) if self.path.is_file() else ""}

    def changes(self, origins: Collection[str]) -> str:
        """See `Importer`."""
        return f"the objects in {self.path}"

    def _splits(self, archive: Archive) -> list[str]:
        """The split of each object; "" for those that are left out.

        Raises:
            ConfigError: a part that the file has not; it may be without those of the defaults.
            DataError: the file has no parts to make folds of.
        """
        for key in ("train_parts", "test_parts"):
            if unknown := sorted({*getattr(self, key)} - {*archive.parts, ADAPT, JUDGE}):
                has = f"its parts are {', '.join(archive.parts)}" if archive.parts else "no parts"
                raise ConfigError(
                    f"published.{key} names {', '.join(unknown)}, which {self.path} has not: {has}"
                )
        if self.fold is None:
            if not (archive.dev != "").any():
                return ["test"] * len(archive)
            split = dict.fromkeys(self.train_parts, "train") | dict.fromkeys(
                self.test_parts, "test"
            )
            return [split.get(str(part), "") for part in archive.dev]
        ours = np.isin(archive.dev, self.train_parts)
        if not ours.any():
            has = f"its parts are {', '.join(archive.parts)}" if archive.parts else "no parts"
            raise DataError(
                f"{self.path} has no objects of {' or '.join(self.train_parts) or 'no part'} "
                f"(published.train_parts) to make folds of: {has} (array `dev`)"
            )
        frames = archive.frame
        blocks = np.unique(frames[ours] // self.block)
        if len(blocks) < self.folds:
            raise DataError(
                f"{self.path}: {counted(len(blocks), 'block')} of frames for training, too few for "
                f"{self.folds} folds"
            )
        tested = np.array_split(blocks, self.folds)[self.fold or 0]
        test = np.isin(frames // self.block, tested) & ours
        of_test = np.unique(frames[test])
        near = np.abs(frames[:, None] - of_test[None]).min(axis=1) <= self.gap
        return [
            "" if not mine else "test" if is_test else "" if close else "train"
            for mine, is_test, close in zip(ours, test, near, strict=True)
        ]


def cluster(frame: int, block: int) -> str:
    """The block of frames that a frame is of."""
    return f"block{frame // block:04d}"


def read_archive(path: Path) -> Archive:
    """Read and check the file; nothing in it is unpickled.

    Raises:
        MissingDataError: there is no such file.
        DataError: damaged, too large, an array missing or of another kind; says which.
    """
    if path.is_dir():
        raise MissingDataError(f"{path} is a folder; an archive of objects is one file, .npz")
    if not path.is_file():
        raise MissingDataError(f"there is no {path}")
    found = plain_arrays(path, _REQUIRED, _OPTIONAL)
    n, p = len(found["cls"]), len(found["xyz_tenth_mm"])
    shapes = {"xyz_tenth_mm": (p, 3), "centre_m": (n, 3), "start": (n + 1,), "inlier": (p,)}
    for key, array in found.items():
        kinds, says = _KINDS[key]
        if array.dtype.kind not in kinds or array.shape != shapes.get(key, (n,)):
            raise DataError(f"{path}: {key} is {array.dtype} {array.shape}, expected {says}")
    start = found["start"].astype(np.int64)
    if n == 0 or start[0] != 0 or start[-1] != p or (np.diff(start) < 1).any():
        raise DataError(f"{path}: start does not part {p} points into {n} objects")
    if not np.isfinite(found["centre_m"]).all():
        bad = int(np.flatnonzero(~np.isfinite(found["centre_m"]).all(axis=1))[0])
        raise DataError(f"{path}, object {bad}: its centre is not finite")
    if unknown := sorted({*found["tier"].tolist()} - {*TIERS}):
        raise DataError(f"{path}: unknown tiers {unknown}; known are {', '.join(TIERS)}")
    if (found["img"] < 0).any():
        raise DataError(f"{path}: img holds negative numbers of frames")
    return Archive(
        path,
        found["cls"],
        found.get("sub", found["cls"]),
        found["tier"],
        found.get("dev", np.full(n, "")),
        found["img"].astype(np.int64),
        found.get("pixels"),
        found.get("rim"),
        found.get("occ"),
        found["xyz_tenth_mm"],
        found["centre_m"],
        start,
        found.get("inlier"),
    )


def _contents(path: Path) -> str:
    """What an .npz holds, by the checksums of its members; nothing is unpacked."""
    digest = hashlib.sha256()
    try:
        with zipfile.ZipFile(path) as archive:
            for member in archive.infolist():
                digest.update(f"{member.filename} {member.file_size} {member.CRC}\n".encode())
    except Exception:  # what zipfile makes of damaged bytes cannot be listed
        return "damaged"  # whoever reads it says so
    return digest.hexdigest()


def is_archive(path: Path) -> bool:
    """Whether a file is an .npz of objects cut from depth images."""
    if path.suffix.lower() != ".npz":
        return False
    try:
        with zipfile.ZipFile(path) as file:
            return "xyz_tenth_mm.npy" in file.namelist()
    except (OSError, zipfile.BadZipFile):
        return False
