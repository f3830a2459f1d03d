"""Published files that hold many clouds: PointDA-10's ScanNet10, ScanObjectNN, and any .npz."""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from qs3.datasets.clouds import read_arrays
from qs3.datasets.importing import Importer, Item, by_class, class_of, cloud_id, split_of, turned
from qs3.errors import DataError
from qs3.store.manifest import ManifestRow
from qs3.store.meta import MadeOf
from qs3.utils.files import reading
from qs3.utils.settings import settings

log = logging.getLogger(__name__)

_KEYS = ("points", "cls", "split", "name")
_NAME = re.compile(r"(train|test)_(\d+)\.h5")
_MIRROR = np.array([1, -1, 1], dtype=np.float32)

SCANOBJECTNN: tuple[str, ...] = (
    *("bag", "bin", "box", "cabinet", "chair", "desk", "display", "door", "shelf", "table"),
    *("bed", "pillow", "sink", "sofa", "toilet"),
)
"""ScanObjectNN's classes in the order of its labels."""

OURS = {"display": "monitor", "shelf": "bookshelf"}
"""Its names of our classes where they differ. A desk is not a table: ModelNet40 has both."""


@settings
class NamedArrays(Importer):
    """One .npz with arrays `points` [N, P, 3], `cls` [N], `split` [N] and `name` [N].

    Attributes:
        file: name of the .npz in the folder.
    """

    file: str = "points.npz"

    @property
    def path(self) -> Path:
        """Where the .npz lies."""
        return self.root / self.file

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(objects=f"arrays of {self.path.name}")

    def looks_for(self) -> str:
        """See `Importer`."""
        return f"{self.path}   (arrays {', '.join(_KEYS)})"

    def is_there(self) -> bool:
        """See `Importer`."""
        return self.path.is_file()

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`; reads the file. Sorted by split, class and name."""
        arrays = named_arrays(self.path)
        found = []
        for i, name in enumerate(arrays["name"].tolist()):
            where = f"{self.path}, cloud {i} ({name})"
            cls = class_of(str(arrays["cls"][i]), classes, where)
            split = split_of(str(arrays["split"][i]), where)
            row = ManifestRow(cloud_id(cls, split, name), cls, split, origin=f"{self.file}[{i}]")
            found.append(Item(row, where, functools.partial(arrays["points"].__getitem__, i)))
        return by_class(found, classes)


def named_arrays(path: Path) -> dict[str, np.ndarray]:
    """The four arrays; DataError if damaged, missing, or of different lengths."""
    arrays = read_arrays(path, _KEYS)
    lengths = {key: len(array) for key, array in arrays.items()}
    if len({*lengths.values()}) > 1 or arrays["points"].shape[2:] != (3,):
        raise DataError(f"{path}: points {arrays['points'].shape} with {lengths}")
    return arrays


@settings
class PointDAH5(Importer):
    """PointDA-10's ScanNet10: `train_0.h5 train_1.h5 train_2.h5 test_0.h5`.

    Each holds `data` [n, 2048, 6] (x y z in metres with y up, floor at 0; then rgb) and `label`
    [n] in the order of `qs3.classes`. The extraction stored (X, Z, Y) of ScanNet's (X, Y, Z): two
    axes were swapped, so after turning y to z every object is the mirror image of the real one (y
    is negated). All published numbers were measured on the mirror images; `undo_mirror` gives the
    real ones.
    """

    undo_mirror: bool = True

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        if self.undo_mirror:  # published figures were measured on mirror images
            return MadeOf(objects="published files, no longer mirrored")
        return MadeOf(objects="published files", published=True)

    def looks_for(self) -> str:
        """See `Importer`."""
        return f"{self.root}/{{train,test}}_*.h5"

    def is_there(self) -> bool:
        """See `Importer`: whether there is a file for each split."""
        return {split for split, _, _ in self._files()} == {"train", "test"}

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`; reads the files, about 50 MB each."""
        files = self._files()
        return [i for split, _, path in files for i in h5_items(path, split, classes, digits=4)]

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        cloud = turned(cloud, "y")
        return cloud * _MIRROR if self.undo_mirror else cloud

    def _files(self) -> list[tuple[str, int, Path]]:
        """(split, number, path), train before test, by number."""
        paths = self.root.iterdir() if self.root.is_dir() else ()
        found = [(m[1], int(m[2]), p) for p in paths if (m := _NAME.fullmatch(p.name))]
        return sorted(found, key=lambda f: (f[0] == "test", f[1]))


@settings
class ScanObjectNN(Importer):
    """ScanObjectNN (Uy et al., ICCV 2019): objects segmented from real scans, 15 classes.

        main_split/{training,test}_objectdataset.h5                          objects as segmented
        main_split/{training,test}_objectdataset_augmentedrot_scale75.h5     PB_T50_RS, the hardest
        main_split_nobg/...                                                  without background

    Each file holds `data` [n, 2048, 3] with y up and `label` [n]. Seven of its classes are ours;
    the clouds of the others are left out. bathtub, lamp and plant are not in it.

    Attributes:
        variant: what follows `_objectdataset` in the files' names, e.g. "_augmentedrot_scale75".
    """

    variant: str = ""
    complete: ClassVar[bool] = False
    up: ClassVar[str] = "y"

    def looks_for(self) -> str:
        """See `Importer`."""
        return f"{self.root}/{{training,test}}_objectdataset{self.variant}.h5"

    def is_there(self) -> bool:
        """See `Importer`: whether both files are there."""
        return all(path.is_file() for _, path in self._files())

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`; reads the files."""
        names = [OURS.get(name, name) for name in SCANOBJECTNN]
        items = [i for split, path in self._files() for i in h5_items(path, split, names, digits=5)]
        ours = [item for item in items if item.row.cls in classes]
        log.info("%s: clouds of other classes left out: %d", self.root, len(items) - len(ours))
        return by_class(ours, classes)

    def _files(self) -> list[tuple[str, Path]]:
        name = f"objectdataset{self.variant}.h5"
        return [("train", self.root / f"training_{name}"), ("test", self.root / f"test_{name}")]


def h5_items(path: Path, split: str, names: Sequence[str], digits: int) -> list[Item]:
    """The clouds of one file, in its order; `names` of the classes by label."""
    data, labels = read_h5(path)
    if len(labels) != len(data) or (labels < 0).any() or (labels >= len(names)).any():
        raise DataError(f"{path}: {len(data)} clouds, and labels that are not 0..{len(names) - 1}")
    items = []
    for number, (cloud, label) in enumerate(zip(data, labels, strict=True)):
        id_ = cloud_id(names[label], split, f"{path.stem}_{number:0{digits}d}")
        row = ManifestRow(id_, names[label], split, origin=f"{path.name}[{number}]")
        items.append(Item(row, f"{path}, cloud {number}", functools.partial(np.asarray, cloud)))
    return items


def read_h5(path: Path) -> tuple[Float[np.ndarray, "n P 3"], Int[np.ndarray, " n"]]:
    """Positions, float32, and labels of one file, axes as stored; DataError if damaged."""
    import h5py

    with reading(path), h5py.File(path, "r") as file:
        points = np.asarray(file["data"][..., :3], dtype=np.float32)
        return points, np.asarray(file["label"][...], dtype=np.int64).reshape(-1)
