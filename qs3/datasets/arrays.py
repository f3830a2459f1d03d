"""Published files that hold many clouds: PointDA-10's ScanNet10, ScanObjectNN, and any .npz."""

from __future__ import annotations

import abc
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float, Int

from qs3.datasets.clouds import read_arrays
from qs3.datasets.importing import Importer, Item, by_class, class_of, cloud_id, split_of, turned
from qs3.store.manifest import ManifestRow
from qs3.store.meta import MadeOf
from qs3.utils.files import reading
from qs3.utils.settings import settings

Cloud = tuple[str, str, str, np.ndarray]
"""Class, split, name and points [P, 3] of one cloud."""

_MIRROR = np.array([1, -1, 1], dtype=np.float32)

SCANOBJECTNN: tuple[str, ...] = (
    *("bag", "bin", "box", "cabinet", "chair", "desk", "monitor", "door", "bookshelf", "table"),
    *("bed", "pillow", "sink", "sofa", "toilet"),
)
"""ScanObjectNN's classes in the order of its labels, "display" and "shelf" by our names.

A desk is not a table: ModelNet40 has both."""


@settings
class ArrayFiles(Importer):
    """Clouds in a few files, several in each; those of classes that are not wanted are left out."""

    ordered: ClassVar[bool] = False
    """Whether the clouds keep the order of the files; else split, class and name order them."""

    @abc.abstractmethod
    def files(self) -> list[tuple[str, Path]]:
        """The split ("" of a file that has several) and the path of each, in order."""

    @abc.abstractmethod
    def clouds(self, path: Path, split: str, classes: Sequence[str]) -> Iterator[Cloud]:
        """The clouds of a file, in its order."""

    def looks_for(self) -> str:
        """See `Importer`."""
        return f"{self.root}/*: " + " ".join(path.name for _, path in self.files())

    def is_there(self) -> bool:
        """See `Importer`."""
        return all(path.is_file() for _, path in self.files())

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`; reads the files."""
        found = []
        for of_file, path in self.files():
            for i, (cls, split, name, cloud) in enumerate(self.clouds(path, of_file, classes)):
                if cls in classes:
                    id_, origin = cloud_id(cls, split, name), f"{path.name}[{i}]"
                    row = ManifestRow(id_, cls, split, origin=origin)
                    load = functools.partial(np.asarray, cloud)
                    found.append(Item(row, f"{path}, cloud {i} ({name})", load))
        return found if self.ordered else by_class(found, classes)


@settings
class NamedArrays(ArrayFiles):
    """One .npz with arrays `points` [N, P, 3], `cls` [N], `split` [N] and `name` [N].

    Attributes:
        file: name of the .npz in the folder.
    """

    file: str = "points.npz"

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(objects=f"arrays of {self.file}")

    def files(self) -> list[tuple[str, Path]]:
        """See `ArrayFiles`."""
        return [("", self.root / self.file)]

    def clouds(self, path: Path, split: str, classes: Sequence[str]) -> Iterator[Cloud]:
        """See `ArrayFiles`."""
        for cloud, cls, split, name in zip(*named_arrays(path).values(), strict=True):
            yield class_of(str(cls), classes, path), split_of(str(split), path), str(name), cloud


@settings
class PointDAH5(ArrayFiles):
    """PointDA-10's ScanNet10: `train_0.h5 train_1.h5 train_2.h5 test_0.h5`.

    Each holds `data` [n, 2048, 6] (x y z in metres with y up, floor at 0; then rgb) and `label`
    [n] in the order of `qs3.classes`. The extraction stored (X, Z, Y) of ScanNet's (X, Y, Z): two
    axes were swapped, so after turning y to z every object is the mirror image of the real one (y
    is negated). All published numbers were measured on the mirror images.
    """

    form: Literal["real", "mirrored"] = "real"
    ordered: ClassVar[bool] = True

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        if self.form == "real":  # published figures were measured on mirror images
            return MadeOf(objects="published files, no longer mirrored")
        return MadeOf(objects="published files", published=True)

    def files(self) -> list[tuple[str, Path]]:
        """See `ArrayFiles`: all that there are, at least one a split."""
        names = {s: sorted(self.root.glob(f"{s}_*.h5")) for s in ("train", "test")}
        return [(s, p) for s in names for p in names[s] or [self.root / f"{s}_0.h5"]]

    def clouds(self, path: Path, split: str, classes: Sequence[str]) -> Iterator[Cloud]:
        """See `ArrayFiles`."""
        return _of_h5(path, split, classes, digits=4)

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        cloud = turned(cloud, "y")
        return cloud * _MIRROR if self.form == "real" else cloud


@settings
class ScanObjectNN(ArrayFiles):
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
    up: ClassVar[str] = "y"

    def files(self) -> list[tuple[str, Path]]:
        """See `ArrayFiles`."""
        name = f"objectdataset{self.variant}.h5"
        return [("train", self.root / f"training_{name}"), ("test", self.root / f"test_{name}")]

    def clouds(self, path: Path, split: str, classes: Sequence[str]) -> Iterator[Cloud]:
        """See `ArrayFiles`."""
        return _of_h5(path, split, SCANOBJECTNN, digits=5)


def named_arrays(path: Path) -> dict[str, np.ndarray]:
    """points, cls, split and name; DataError if damaged, missing, or of different lengths."""
    arrays = read_arrays(path, ("points", "cls", "split", "name"))
    with reading(path):
        assert len({*map(len, arrays.values())}) == 1, "its arrays have different lengths"
        assert arrays["points"].shape[2:] == (3,), f"points of shape {arrays['points'].shape}"
    return arrays


def read_h5(path: Path) -> tuple[Float[np.ndarray, "n P 3"], Int[np.ndarray, " n"]]:
    """Positions, float32, and labels of one file, axes as stored; DataError if damaged."""
    import h5py

    with reading(path), h5py.File(path, "r") as file:
        points = np.asarray(file["data"][..., :3], dtype=np.float32)
        return points, np.asarray(file["label"][...], dtype=np.int64).reshape(-1)


def _of_h5(path: Path, split: str, names: Sequence[str], digits: int) -> Iterator[Cloud]:
    """The clouds of one file; `names` of the classes by label."""
    data, labels = read_h5(path)
    with reading(path):
        assert len(labels) == len(data), f"{len(data)} clouds and {len(labels)} labels"
        assert ((labels >= 0) & (labels < len(names))).all(), f"labels not 0..{len(names) - 1}"
    for number, (cloud, label) in enumerate(zip(data, labels.tolist(), strict=True)):
        yield names[label], split, f"{path.stem}_{number:0{digits}d}", cloud
