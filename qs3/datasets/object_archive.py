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

Frames in a row show one room: objects of one block of frames are not independent, and a part of the
archive that judges is blocks away from one that is trained on.
"""

import functools
import hashlib
import logging
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge
from jaxtyping import Float

from qs3.datasets.clouds import read_arrays
from qs3.datasets.importing import Importer, Item, by_class, class_of
from qs3.errors import ConfigError
from qs3.store.meta import MadeOf, ManifestRow
from qs3.utils.files import reading
from qs3.utils.settings import settings

log = logging.getLogger(__name__)

TIERS: tuple[str, ...] = ("clean", "hard")
ADAPT, JUDGE = "adapt", "judge"
"""Parts of an archive's `dev`: what one trains and chooses on, and what is looked at once."""

_METRES = 1e-4
_OPTIONAL = ("inlier", "sub", "dev")
_REQUIRED = ("xyz_tenth_mm", "centre_m", "start", "cls", "tier", "img")


@dataclass(frozen=True, eq=False)
class Archive:
    """What the file holds.

    Attributes:
        path: of the file.
        cls, sub, tier, dev: [N] text; `sub` is `cls` and `dev` empty where the file has none.
        frame: [N] number of the frame.
        arrays: all that the file holds.
    """

    path: Path
    cls: np.ndarray
    sub: np.ndarray
    tier: np.ndarray
    dev: np.ndarray
    frame: np.ndarray
    arrays: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        """N."""
        return len(self.cls)

    @property
    def parts(self) -> list[str]:
        """Names of the parts of `dev`."""
        return sorted({*self.dev.tolist()} - {""})

    def of_part(self, part: str) -> list[int]:
        """Positions of the objects of a part; ConfigError if there are none."""
        if part not in self.parts:
            raise ConfigError(f"part={part}: {self.path} has the parts {', '.join(self.parts)}")
        return np.flatnonzero(self.dev == part).tolist()

    def cloud(self, index: int) -> Float[np.ndarray, "n 3"]:
        """[n, 3] float32 metres, z up, the camera at the origin, without stray points."""
        part = slice(*self.arrays["start"][index : index + 2])
        centre = self.arrays["centre_m"][index].astype(np.float64)
        xyz = self.arrays["xyz_tenth_mm"][part] * _METRES + centre
        if "inlier" in self.arrays:
            kept = self.arrays["inlier"][part]
            xyz = xyz[kept] if kept.any() else xyz
        return np.asarray(xyz, dtype=np.float32)


@settings
class ObjectArchive(Importer):
    """See the module; conf/domain/objects.yaml explains its settings."""

    file: str = "objects.npz"
    fold: Annotated[int, Ge(0)] | None = None
    folds: Annotated[int, Ge(2)] = 5
    gap: Annotated[int, Ge(0)] = 15
    block: Annotated[int, Ge(1)] = 30
    tiers: list[Literal["clean", "hard"]] = field(default_factory=lambda: ["clean", "hard"])
    thins: ClassVar[bool] = True

    @property
    def path(self) -> Path:
        """Where the .npz lies."""
        return self.root / Path(self.file).expanduser()

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(objects=f"real objects cut from depth images, archive {self.path.name}")

    def files(self) -> list[Path]:
        """See `Importer`."""
        return [self.path]

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`; reads the file. Sorted by split, class and id."""
        archive = read_archive(self.path)
        splits = self._splits(archive)
        found, left = [], Counter[str]()
        for i in range(len(archive)):
            cls = class_of(str(archive.cls[i]), classes, f"{archive.path}, object {i}")
            split, tier, frame = splits[i], str(archive.tier[i]), int(archive.frame[i])
            if not split or tier not in self.tiers:
                left[tier if split else str(archive.dev[i])] += 1
                continue
            name = f"block{frame // self.block:04d}_{frame:05d}_{i}"
            more = {"frame": str(frame), "sub": str(archive.sub[i]), "tier": tier}
            origin = f"{self.path.name}[{i}]"
            row = ManifestRow(f"{cls}/{split}/{name}", cls, split, None, "", origin, 1, more=more)
            found.append(Item(row, functools.partial(archive.cloud, i)))
        if left:
            log.info("%s: objects left out: %s", self.path, dict(sorted(left.items())))
        return by_class(found, classes)

    def object_of(self, id_: str) -> str:
        """See `Importer`: the block of frames."""
        return id_.rsplit("/", 1)[-1].rsplit("_", 2)[0]

    def settings(self) -> dict[str, Any]:
        """See `Importer`; the file by what it holds: a copy of it elsewhere is the same archive."""
        values = super().settings()
        del values["folder"], values["file"]
        return {**values, "files": _contents(self.path) if self.path.is_file() else ""}

    def _splits(self, archive: Archive) -> list[str]:
        """The split of each object; "" for those that are left out."""
        if self.fold is None:
            if not (archive.dev != "").any():
                return ["test"] * len(archive)
            return [{ADAPT: "train", JUDGE: "test"}.get(str(part), "") for part in archive.dev]
        ours, frames = archive.dev == ADAPT, archive.frame
        blocks = np.unique(frames[ours] // self.block)
        assert self.fold < self.folds <= len(blocks), f"{len(blocks)} blocks of frames"
        tested = np.array_split(blocks, self.folds)[self.fold]
        test = np.isin(frames // self.block, tested) & ours
        of_test = np.unique(frames[test])
        near = np.abs(frames[:, None] - of_test[None]).min(axis=1) <= self.gap
        return np.select([~ours, test, near], ["", "test", ""], "train").tolist()


def read_archive(path: Path) -> Archive:
    """Read and check the file; nothing in it is unpickled."""
    found = read_arrays(path, _REQUIRED, _OPTIONAL)
    n, p, start = len(found["cls"]), len(found["xyz_tenth_mm"]), found["start"].astype(np.int64)
    lengths = {"xyz_tenth_mm": p, "inlier": p, "start": n + 1}
    with reading(path):
        odd = [key for key, array in found.items() if len(array) != lengths.get(key, n)]
        assert not odd, f"arrays {odd} do not describe {n} objects of {p} points"
        assert start[0] == 0, "start does not begin at 0"
        assert start[-1] == p, "start does not end at the number of points"
        assert (np.diff(start) >= 1).all(), "start does not ascend"
        assert np.isfinite(found["centre_m"]).all(), "centre_m is not finite"
        assert {*found["tier"].tolist()} <= {*TIERS}, "tier is not clean or hard"
    return Archive(
        path,
        cls=found["cls"],
        sub=found.get("sub", found["cls"]),
        tier=found["tier"],
        dev=found.get("dev", np.full(n, "")),
        frame=found["img"].astype(np.int64),
        arrays={**found, "start": start},
    )


def _contents(path: Path) -> str:
    """What an .npz holds, by the checksums of its members; nothing is unpacked."""
    with reading(path), zipfile.ZipFile(path) as archive:
        members = [f"{m.filename} {m.file_size} {m.CRC}\n" for m in archive.infolist()]
    return hashlib.sha256("".join(members).encode()).hexdigest()


def is_archive(path: Path) -> bool:
    """Whether a file is an .npz of objects cut from depth images."""
    if path.suffix.lower() != ".npz" or not zipfile.is_zipfile(path):
        return False
    with reading(path), zipfile.ZipFile(path) as file:
        return "xyz_tenth_mm.npy" in file.namelist()
