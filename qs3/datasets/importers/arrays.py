"""One .npz with arrays `points` [N, P, 3], `cls` [N], `split` [N] and `name` [N]."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.datasets.clouds.arrays import read_npz
from qs3.datasets.importers.base import Importer, Item, by_class, class_of, cloud_id, split_of
from qs3.errors import DataError
from qs3.store.manifest import ManifestRow
from qs3.store.meta import MadeOf
from qs3.utils.text_table import printable

_KEYS = ("points", "cls", "split", "name")


@dataclass(frozen=True)
class NamedArrays(Importer):
    """See the module.

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
        return MadeOf(objects=f"arrays of {printable(self.path.name)}")

    def looks_for(self) -> list[str]:
        """See `Importer`."""
        return [f"{self.path}   (arrays {', '.join(_KEYS)})"]

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


def plain_arrays(
    path: Path, required: Sequence[str], optional: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Some arrays of an .npz; nothing in it is unpickled.

    Raises:
        DataError: damaged, pickled, too large, an array missing, or a single value for one.
    """

    def choose(names: list[str]) -> list[str]:
        if missing := [key for key in required if key not in names]:
            raise DataError(f"{path} has no arrays {missing}; it has {names}")
        return [key for key in (*required, *optional) if key in names]

    arrays = read_npz(path, choose)
    if single := [key for key, array in arrays.items() if array.ndim == 0]:
        raise DataError(f"{path}: {', '.join(single)} is a single value, not an array")
    return arrays


def named_arrays(path: Path) -> dict[str, np.ndarray]:
    """The four arrays; DataError if damaged, pickled, too large, missing or of another shape."""
    arrays = plain_arrays(path, _KEYS)
    points = arrays["points"]
    if points.ndim != 3 or points.shape[2] != 3 or points.dtype.kind != "f":
        raise DataError(f"{path}: points is {points.dtype} {points.shape}, not floats [N, P, 3]")
    for key in _KEYS[1:]:
        if arrays[key].shape != points.shape[:1] or arrays[key].dtype.kind != "U":
            raise DataError(
                f"{path}: {key} is {arrays[key].dtype} {arrays[key].shape}, expected "
                f"{len(points)} strings"
            )
    return arrays
