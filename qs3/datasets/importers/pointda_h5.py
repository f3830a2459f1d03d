"""PointDA-10's ScanNet10: `train_0.h5 train_1.h5 train_2.h5 test_0.h5`.

Each holds `data` [n, 2048, 6] (x y z in metres with y up, floor at 0; then rgb) and `label` [n]
in the order of `qs3.classes`. The extraction stored (X, Z, Y) of ScanNet's (X, Y, Z): two axes were
swapped, so after turning y to z every object is the mirror image of the real one (y is negated).
All published numbers were measured on the mirror images; `undo_mirror` gives the real ones.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.datasets.clouds.hdf5 import HDF5_DAMAGE, open_hdf5, own_dataset
from qs3.datasets.importers.base import Importer, Item, cloud_id, inside, turned
from qs3.errors import DataError
from qs3.store.manifest import ManifestRow
from qs3.store.meta import MadeOf
from qs3.utils.memory import check_memory

_NAME = re.compile(r"(train|test)_(\d+)\.h5")
_MIRROR = np.array([1, -1, 1], dtype=np.float32)


@dataclass(frozen=True)
class PointDAH5(Importer):
    """See the module.

    Attributes:
        undo_mirror: give the objects as they are, not their mirror images.
    """

    undo_mirror: bool = True

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        if self.undo_mirror:  # published figures were measured on mirror images
            return MadeOf(objects="published files, no longer mirrored")
        return super().made_of()

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        return [f"{self.root}/train_*.h5", f"{self.root}/test_*.h5"]

    def is_there(self) -> bool:
        """See `Importer`: whether there is a file for each split."""
        return {split for split, _, _ in self._files()} == {"train", "test"}

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`; reads the files, about 50 MB each."""
        return [
            item
            for split, _, path in self._files()
            for item in h5_items(path, self.root, split, classes, digits=4)
        ]

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        cloud = turned(cloud, "y")
        return cloud * _MIRROR if self.undo_mirror else cloud

    def _files(self) -> list[tuple[str, int, Path]]:
        """(split, number, path), train before test, by number."""
        if not self.root.is_dir():
            return []
        found = [(m, p) for p in self.root.iterdir() if (m := _NAME.fullmatch(p.name))]
        return sorted(
            ((m[1], int(m[2]), p) for m, p in found), key=lambda f: (f[0] == "test", f[1])
        )


def h5_items(path: Path, root: Path, split: str, names: Sequence[str], digits: int) -> list[Item]:
    """The clouds of one file below `root`, in its order; `names` of the classes by label.

    Raises:
        DataError: as `read_h5`; or the file is a link out of `root`.
    """
    data, labels = read_h5(inside(path, root), len(names))
    items = []
    for number, (cloud, label) in enumerate(zip(data, labels, strict=True)):
        id_ = cloud_id(names[label], split, f"{path.stem}_{number:0{digits}d}")
        row = ManifestRow(id_, names[label], split, origin=f"{path.name}[{number}]")
        items.append(Item(row, f"{path}, cloud {number}", functools.partial(np.asarray, cloud)))
    return items


def read_h5(path: Path, classes: int) -> tuple[np.ndarray, np.ndarray]:
    """[n, P, 3] float32 and [n] int64 labels of one file, axes as stored.

    Raises:
        DataError: truncated, other shapes, a label out of range, or contents that lie elsewhere.
    """
    try:
        with open_hdf5(path) as file:
            data, label = (own_dataset(file, (key,), path) for key in ("data", "label"))
            for key, found in (("data", data), ("label", label)):
                if found is None:
                    raise DataError(f"{path}: there is no dataset {key!r}")
            if data.shape is None or label.shape is None:
                raise DataError(f"{path}: a dataset is empty")
            if data.ndim != 3 or data.shape[2] not in (3, 6) or data.dtype.kind != "f":
                raise DataError(
                    f"{path}: data is {data.dtype} {data.shape}, expected floats [n, P, 3 or 6]"
                )
            n = len(data)
            if label.shape not in ((n,), (n, 1)) or label.dtype.kind not in "iu":
                raise DataError(
                    f"{path}: label is {label.dtype} {label.shape}, expected integers [{n}]"
                )
            check_memory(2 * data.size * data.dtype.itemsize, path)
            points = np.asarray(data[..., :3], dtype=np.float32)
            labels = np.asarray(label[...], dtype=np.int64).reshape(n)
    except HDF5_DAMAGE as error:
        raise DataError(f"{path}: not a readable HDF5 file ({error})") from error
    if bad := np.flatnonzero((labels < 0) | (labels >= classes)).tolist():
        raise DataError(f"{path}, cloud {bad[0]}: label {labels[bad[0]]} is not 0..{classes - 1}")
    return points, labels
