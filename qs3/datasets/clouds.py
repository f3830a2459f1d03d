"""Your own point clouds, of any number of points: files in the usual formats, and folders of them.

    .xyz .txt   text, a row a point: x y z and perhaps more columns, between blanks, commas or
                semicolons; # and // begin a comment. A first row of names, also as a comment,
                says which columns are x, y and z
    .npy        [n, >= 3], or [m, n, >= 3]: m clouds
    .npz        the array `points` (or the only one) as in .npy; perhaps `cls`, `label` or `labels`
    .ply        the vertices, text or binary; faces are passed over
    .pcd        x y z
    .h5 .hdf5   the dataset `data` or `points` as in .npy; perhaps `label` or `labels`

Only x y z are read. Pickled arrays are refused unopened.
"""

import dataclasses
import functools
import logging
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge
from jaxtyping import Float

from qs3.datasets.importing import (
    Importer,
    Item,
    UpAxis,
    by_class,
    class_of,
    cloud_id,
    split_of,
)
from qs3.errors import DataError
from qs3.store.meta import MadeOf, ManifestRow
from qs3.utils.files import reading
from qs3.utils.settings import settings

log = logging.getLogger(__name__)

_XYZ = ["x", "y", "z"]
_ENDS = ",; \t"  # of a row
_MOST_COLUMNS = 32  # x y z, normals, colours and what else programs write; a picture has more
_FEW = 10  # more columns than that in three rows: points stand in columns
_MOST = 1e18  # of a coordinate: squares of distances overflow in float32 from about 1e19 on
_FINE = 2.0**-13  # of the cloud, that a step of float32 may be: 0.1 mm of a chair

_SPLIT_NAMES = ("train", "test", "val", "validation")
_SPLIT_PREFIX = re.compile(rf"({'|'.join(_SPLIT_NAMES)})(?![a-z])", re.IGNORECASE)  # train_0.h5
_MANY = (".npy", ".npz", ".h5", ".hdf5")  # may hold several clouds


@dataclass(frozen=True, eq=False)
class CloudFile:
    """What a file holds.

    Attributes:
        clouds: [n, 3] each, of any numbers.
        labels: of each cloud as the file has them, a number or a word; None if it has none.
        many: whether the file is made for several clouds (then each has a number in its name).
    """

    clouds: Sequence[np.ndarray]
    labels: tuple[Any, ...] | None = None
    many: bool = False


def parse_clouds(path: str | Path) -> CloudFile:
    """All clouds of a file, with the numbers that it holds; DataError names the file."""
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(f"{path}: unknown format; known are {', '.join(SUFFIXES)}")
    with reading(path), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = reader(path)
        assert sum(map(len, found.clouds[:1])), "there are no points"
    return found


def parse_cloud(path: str | Path) -> np.ndarray:
    """[n, 3] as they are in the file: the one cloud in it; see `parse_clouds`."""
    found = parse_clouds(path)
    if len(found.clouds) != 1:
        raise DataError(f"{path} holds {len(found.clouds)} clouds, expected one")
    return found.clouds[0]


def read_arrays(
    path: Path, required: Sequence[str], optional: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Some arrays of an .npz; nothing in it is unpickled."""
    with reading(path), open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
        return {key: file[key] for key in (*required, *(k for k in optional if k in file))}


def check_shape(where: Any, shape: tuple[int, ...]) -> None:
    """Raise DataError for an array whose rows cannot be points: transposed, or a depth image.

    Points are [n, >= 3], one a row with perhaps more columns, or [m, n, >= 3], m clouds.
    """
    rows, columns = shape[-2:] if len(shape) in (2, 3) else (0, 0)
    if not 3 <= columns <= _MOST_COLUMNS or (rows == 3 and columns > _FEW):
        raise DataError(
            f"{where}: shape {shape}, not rows of points [n, 3] or [m, n, 3]; see depth="
        )


def with_depth(cloud: np.ndarray, where: str) -> tuple[np.ndarray, int]:
    """[n, 3] without the points that stand for no measurement, and how many these were.

    Depth cameras write NaN, infinity or (0, 0, 0) for a pixel that saw nothing. One point that is
    exactly (0, 0, 0) stays: a shape about the origin may have it. DataError if no point is left.
    """
    kept = np.isfinite(cloud).all(axis=1)
    nothing = (cloud == 0).all(axis=1)
    if nothing.sum() > 1:
        kept &= ~nothing
    if not kept.any():
        raise DataError(f"{where}: all {len(cloud)} points are NaN, infinite or (0, 0, 0)")
    return (cloud if kept.all() else cloud[kept]), int((~kept).sum())


def checked(cloud: np.ndarray, where: str) -> Float[np.ndarray, "n 3"]:
    """[n, 3] of any numbers to float32.

    A map's coordinates are so far from their origin that float32 has steps of decimetres there:
    such x and y are moved to 0. z is a height and is never moved.
    """
    with np.errstate(over="ignore"):  # becomes infinite, and is reported as such
        small = np.asarray(cloud, dtype=np.float32)
    fits = np.isfinite(small).all(axis=1) & (np.abs(small).max(axis=1, initial=0) <= _MOST)
    if not len(small) or not fits.all():
        which = f"point {int(np.argmin(fits)) + 1} is" if len(small) else "there are no points,"
        raise DataError(f"{where}: {which} not finite, or too far away for distances in float32")
    low, high = cloud.min(axis=0).astype(np.float64), cloud.max(axis=0).astype(np.float64)
    extent = float((high - low).max())
    coarse = np.spacing(np.abs(small).max(axis=0)) > _FINE * extent
    if extent == 0 or not coarse.any():
        return small
    if coarse[2] or cloud.dtype in (np.float32, np.float16):  # the digits are lost
        raise DataError(f"{where}: float32 is too coarse for its coordinates; subtract an offset")
    moved: np.ndarray = np.asarray(cloud, np.float64) - np.where(coarse, (low + high) / 2, 0)
    return moved.astype(np.float32)


@settings
class CloudFolder(Importer):
    """Your own clouds: a folder of files in any format of this module.

        class/split/name.ext     split is train, test, or val (validation)
        split/class/name.ext
        class/name.ext           every `test_every`-th of a class, sorted by name, is for test
        split/name.ext           no labels
        name.ext, any/where.ext  no labels: all of it is the split "train"

    A file may hold several clouds (.npy, .npz, .h5 with an array [m, n, 3]); they are then called
    name_0000, name_0001, ... If it has labels, numbers count the classes from 0 and words are
    names. Such a file may have its split before its name, train_0.h5, where no folder is one.

    A cloud with more than P points is thinned to its P farthest; one with fewer repeats its points.
    Points without depth are left out before (`with_depth`).

    Attributes:
        layout: "none": no folder is a class or a split.
        up: the axis that points up in the files.
        test_every: where all folders are classes; 0 leaves nothing for test.
    """

    layout: Literal["auto", "none"] = "auto"
    up: UpAxis = "z"
    test_every: Annotated[int, Ge(0)] = 5
    thins: ClassVar[bool] = True
    holds: ClassVar[str] = "**/* of the formats xyz txt npy npz ply pcd h5 hdf5"

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(objects=f"own clouds of {self.root.name}")

    def is_there(self) -> bool:
        """See `Importer`: whether there is any file of a known format."""
        return next(_files(self.root), None) is not None

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`. Sorted by split, class and name."""
        read = functools.lru_cache(maxsize=1)(parse_clouds)  # one file in memory at a time
        places = {path: self._place(path, classes) for path in self.watched()}
        found = [
            item
            for path, (cls, split) in places.items()
            for item in self._of_file(path, cls, split, classes, read)
        ]
        if self.test_every and all(cls and not split for cls, split in places.values()):
            found = _with_tests(found, self.test_every)
        return by_class(found, classes)

    def watched(self) -> Iterable[Path]:
        """See `Importer`."""
        return sorted(_files(self.root))

    def _place(self, path: Path, classes: Sequence[str]) -> tuple[str, str]:
        """Class and split of a file by its folders; each "" where they do not say."""
        if self.layout == "none":
            return "", ""
        folders = path.relative_to(self.root).parts[:-1]
        splits = [name for name in folders if name.casefold() in _SPLIT_NAMES]
        others = [name for name in folders if name not in splits]
        if len(splits) > 1 or len(others) > 1:
            raise DataError(f"{path}: expected a folder of a class, and perhaps one of a split")
        where = f"{path} (published.layout=none reads without labels)"
        cls = class_of(others[0], classes, where) if others else ""
        return cls, split_of(splits[0], path) if splits else ""

    def _of_file(
        self,
        path: Path,
        cls: str,
        split: str,
        classes: Sequence[str],
        read: Callable[[Path], CloudFile],
    ) -> Iterator[Item]:
        """The clouds of a file; of those that may hold several only number and labels are kept."""
        below, file = path.relative_to(self.root), CloudFile((np.empty(0),))
        if path.suffix.lower() in _MANY:
            try:
                file = read(path)
            except DataError:
                log.info("%s is damaged", path)  # reading it again says why
        if file.many and not (cls or split) and (prefix := _SPLIT_PREFIX.match(path.stem)):
            split = split_of(prefix[1], path)
        for i in range(len(file.clouds)):
            number, place = (f"_{i:04d}", f"{below.as_posix()}[{i}]") if file.many else ("", "")
            place = place or below.as_posix()
            own = _label(file.labels[i], classes, path) if file.labels and not cls else cls
            plain = below.with_suffix("").as_posix() if self.layout == "none" else path.stem
            id_ = cloud_id(own, split or "train", (path.stem if own else plain) + number)
            row = ManifestRow(id_, own, split or "train", origin=place)
            yield Item(row, functools.partial(_cloud, read, path, i, f"{self.root}/{place}"))


def _cloud(read: Callable[[Path], CloudFile], path: Path, number: int, where: str) -> np.ndarray:
    """[n, 3] float32, without points that have no depth, and checked."""
    cloud, dropped = with_depth(read(path).clouds[number], where)
    if dropped:
        log.info("%s: points without depth left out: %d", where, dropped)
    return checked(cloud, where)


def _with_tests(items: Iterable[Item], every: int) -> list[Item]:
    """The last of every `every` of a class, in the order of ids, goes to test."""
    seen: Counter[str] = Counter()
    result = []
    for item in sorted(items, key=lambda item: item.row.id):
        row = item.row
        seen[row.cls] += 1
        if seen[row.cls] % every == 0:
            id_ = cloud_id(row.cls, "test", row.id.removeprefix(f"{row.cls}/train/"))
            item = item._replace(row=dataclasses.replace(row, id=id_, split="test"))
        result.append(item)
    return result


def _label(label: Any, classes: Sequence[str], where: Path) -> str:
    """The class that a file's own label means: a name, or a number from 0."""
    if isinstance(label, bytes):
        label = label.decode(errors="replace")
    if isinstance(label, int) and 0 <= label < len(classes):
        return classes[label]
    return class_of(str(label), classes, where)


def visible_files(folder: Path) -> Iterator[Path]:
    """All files below a folder that are not hidden; links to folders are not followed."""
    for path in folder.rglob("*"):
        below = path.relative_to(folder).parts
        if not any(part.startswith((".", "__MACOSX")) for part in below) and path.is_file():
            yield path


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in visible_files(folder) if path.suffix.lower() in SUFFIXES)


def _text(path: Path) -> CloudFile:
    """Coordinates of all rows, float64: the columns named x, y and z, else the first three."""
    names: list[str] = []
    rows: list[str] = []
    text = path.read_bytes().decode("utf-8-sig", "replace").replace("//", "#")
    for line in text.splitlines():
        row, _, comment = (part.strip(_ENDS) for part in line.partition("#"))
        found = [] if rows else re.findall(r"[^,;\s]+", row or comment)
        words = [word.strip('"').lower() for word in found]
        if all(words.count(axis) == 1 for axis in _XYZ):
            names = words
        elif row:
            rows.append(row)
    kinds = {*re.findall(r"[,;\s]+", rows[0])}
    separators = {kind.strip() for kind in kinds}
    if len(separators) > 1 or (len(kinds) > 1 and separators == {","} and "." not in rows[0]):
        raise ValueError(f"{rows[0][:60]!r}: its numbers stand between different separators")
    separator = "".join(separators) or None
    table = np.loadtxt(rows, dtype=np.float64, ndmin=2, delimiter=separator, comments=None)
    check_shape(path, table.shape)
    if len(names) != table.shape[1]:
        if names and names[:3] != _XYZ:  # x would be an id, or a colour
            raise ValueError(f"{len(names)} names of columns, but {table.shape[1]} columns")
        names = _XYZ
    return CloudFile((table[:, [names.index(axis) for axis in _XYZ]],))


def _npy(path: Path) -> CloudFile:
    return _of_array(np.load(path, allow_pickle=False))


def _npz(path: Path) -> CloudFile:
    with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
        points = file["points"] if len(file.files) > 1 else file[file.files[0]]
        labels = next((file[key] for key in ("cls", "label", "labels") if key in file), None)
        return _of_array(points, labels)


def _ply(path: Path) -> CloudFile:
    import trimesh

    found: Any = trimesh.load(path, process=False)
    return CloudFile((np.asarray(found.vertices),))


def _pcd(path: Path) -> CloudFile:
    from pypcd4 import PointCloud

    return CloudFile((PointCloud.from_path(path).numpy(tuple(_XYZ)).astype(np.float64),))


def _hdf5(path: Path) -> CloudFile:
    import h5py

    with h5py.File(path, "r") as file:
        data = file["data"] if "data" in file else file["points"]
        label = next((file[key] for key in ("label", "labels") if key in file), None)
        return _of_array(data[...], None if label is None else np.asarray(label[...]).reshape(-1))


def _of_array(array: np.ndarray, labels: np.ndarray | None = None) -> CloudFile:
    assert array.dtype.kind in "fiu", f"the array holds {array.dtype}, not numbers"
    check_shape("the array", array.shape)
    many = array.ndim == 3
    clouds = array[..., :3] if many else array[None, :, :3]
    assert labels is None or labels.shape == (len(clouds),), f"labels {labels.shape}"
    return CloudFile(tuple(clouds), None if labels is None else tuple(labels.tolist()), many)


_READERS: dict[str, Callable[[Path], CloudFile]] = {
    **{".xyz": _text, ".txt": _text, ".npy": _npy, ".npz": _npz, ".ply": _ply, ".pcd": _pcd},
    **{".h5": _hdf5, ".hdf5": _hdf5},
}
SUFFIXES: tuple[str, ...] = tuple(_READERS)
"""Suffixes of the formats that are read, in lower case."""
