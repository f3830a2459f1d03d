"""Point clouds of any number of points from files in the usual formats; files are not trusted.

    .xyz .txt   text, a row a point: x y z and perhaps more columns, by blanks, commas or
                semicolons; # and // begin a comment
    .npy        [n, >= 3], or [m, n, >= 3]: m clouds
    .npz        the array `points` (or the only one) as in .npy; perhaps `label` or `cls`
    .ply        the vertices, text or binary; faces are passed over
    .pcd        x y z
    .h5 .hdf5   the dataset `data` or `points` as in .npy; perhaps `label`

Only x y z are read. Points that are NaN or infinite, as depth cameras write them, are left out and
counted. Pickled arrays are refused unopened, and what takes more memory than `qs3.utils.memory`
allows, before it is taken. Whatever is wrong with a file, the error is a DataError.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.clouds.pcd import read_pcd
from qs3.errors import DataError, MeshError, Qs3Error
from qs3.utils.memory import check_memory


@dataclass(frozen=True, eq=False)
class CloudFile:
    """What a file holds.

    Attributes:
        clouds: [n, 3] each; float32 and finite from `read_clouds`, as in the file from
            `parse_clouds`.
        labels: of each cloud as the file has them, a number or a word; None if it has none.
        dropped: points that are NaN or infinite and that `read_clouds` left out, of all clouds.
        many: whether the file is made for several clouds (then each has a number in its name).
    """

    clouds: tuple[np.ndarray, ...]
    labels: tuple[Any, ...] | None = None
    dropped: int = 0
    many: bool = False


def read_cloud(path: str | Path) -> np.ndarray:
    """[n, 3] float32 coordinates of the one cloud in a file, n >= 1, finite.

    Raises:
        DataError: names the file and what is wrong with it, or it holds several clouds.
    """
    return _only(path, read_clouds(path))


def read_clouds(path: str | Path) -> CloudFile:
    """All clouds of a file, without points that are not finite, and checked.

    Raises:
        DataError: names the file, and the line or cloud.
    """
    found = parse_clouds(path)
    clouds, dropped = [], 0
    for i, whole in enumerate(found.clouds):
        where = f"{path}, cloud {i}" if found.many else str(path)
        cloud, lost = measured(whole, where)
        clouds.append(checked(cloud, where))
        dropped += lost
    return dataclasses.replace(found, clouds=tuple(clouds), dropped=dropped)


def measured(cloud: np.ndarray, where: str) -> tuple[np.ndarray, int]:
    """[n, 3] without the points that are NaN or infinite, and how many these were.

    Numbers too large for float32 stay: `checked` names them.

    Raises:
        DataError: no point is left.
    """
    finite = np.isfinite(cloud).all(axis=1)
    if finite.all():
        return cloud, 0
    if not finite.any():
        raise DataError(f"{where}: all {len(cloud)} points are not finite (NaN or infinite)")
    return cloud[finite], int((~finite).sum())


def checked(cloud: np.ndarray, where: str) -> np.ndarray:
    """[n, 3] of any numbers to float32.

    Raises:
        DataError: no points, or a value that is not finite in float32 (above 3.4e38, or NaN).
    """
    if len(cloud) == 0:
        raise DataError(f"{where}: there are no points")
    with np.errstate(over="ignore"):  # becomes infinite, and is reported as such
        small = np.asarray(cloud, dtype=np.float32)
    if not (finite := np.isfinite(small).all(axis=1)).all():
        row = int(np.flatnonzero(~finite)[0])
        raise DataError(
            f"{where}, point {row + 1}: {cloud[row].tolist()} is not finite in float32; "
            "leave such points out"
        )
    return small


def parse_clouds(path: str | Path) -> CloudFile:
    """All clouds of a file with the numbers that it holds; they are not looked at.

    Raises:
        DataError: names the file, and the line.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(f"{path}: unknown format; known are {', '.join(SUFFIXES)}")
    try:
        if not (size := path.stat().st_size):
            raise DataError(f"{path}: 0 bytes, there are no points")
        check_memory(2 * size, path)
        found = reader(path)
    except Qs3Error:
        raise
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror or error})") from error
    except Exception as error:  # what damaged bytes do to a reader cannot be listed
        raise DataError(f"{path} cannot be read ({type(error).__name__}: {error})") from error
    if not found.clouds:
        raise DataError(f"{path}: there are no clouds")
    return found


def parse_cloud(path: str | Path) -> np.ndarray:
    """[n, 3] as they are in the file: the one cloud in it; see `parse_clouds`.

    Raises:
        DataError: names the file, and the line; or it holds several clouds.
    """
    return _only(path, parse_clouds(path))


def _only(path: str | Path, found: CloudFile) -> np.ndarray:
    if len(found.clouds) != 1:
        raise DataError(f"{path} holds {len(found.clouds)} clouds, expected one")
    return found.clouds[0]


def _text(path: Path) -> CloudFile:
    data = path.read_bytes()
    # Copies and numbers, eight bytes from two letters; and each line is an object.
    check_memory(8 * len(data) + 48 * (data.count(b"\n") + data.count(b"\r")), path)
    rows = data.replace(b"//", b"#")
    if _decimal_commas(rows):
        rows = rows.replace(b",", b".").replace(b";", b" ")
    elif b"," in rows or b";" in rows:
        rows = rows.translate(bytes.maketrans(b",;", b"  "))
    lines = rows.splitlines()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # no rows: reported below
            table = np.loadtxt(lines, dtype=np.float64, ndmin=2, comments="#", encoding="latin-1")
    except ValueError:
        table = None
    if table is None or (table.size and table.shape[1] < 3):
        raise DataError(_bad_line(path, lines))
    if table.size == 0:
        raise DataError(f"{path}: there are no points")
    return CloudFile((table[:, :3],))


def _decimal_commas(rows: bytes) -> bool:
    """Whether the first row is as "0,5;1,25;2,75" or "0,5 1,25 2,75": commas within numbers."""
    first = re.search(rb"^[ \t]*[^\s#][^\r\n]*", rows, re.MULTILINE)
    words = re.split(rb"[;\s]+", first[0].split(b"#")[0].strip()) if first else []
    if not any(b"," in word for word in words):
        return first is not None and b";" in first[0]  # between numbers there is something else
    within = [
        re.fullmatch(rb"[-+]?(\d+,\d+|\d*\.?\d*)([eE][-+]?\d+)?", word) for word in words if word
    ]
    return all(within) and len(within) > 1


def _bad_line(path: Path, lines: list[bytes]) -> str:
    """Where and why a text file is not rows of numbers."""
    width = None
    for number, line in enumerate(lines, start=1):
        words = line.split(b"#")[0].split()
        if not words:
            continue
        shown = printable(line[:60].decode(errors="backslashreplace").strip())[:60]
        try:
            [float(word) for word in words]
        except ValueError:
            return f"{path}, line {number}: '{shown}' is not a row of numbers"
        if len(words) < 3 or (width is not None and len(words) != width):
            return f"{path}, line {number}: '{shown}' has {len(words)} numbers, not {width or 3}"
        width = len(words)
    return f"{path}: not a text file of rows with numbers"


def printable(text: str) -> str:
    """One line that a terminal and a table can show: what is not printable becomes escapes."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text
    )


def npy_clouds(path: Path) -> int | None:
    """How many clouds an .npy file is made for, from its header alone; None: a single one.

    Raises:
        DataError: as `read_clouds`, but for the numbers themselves.
    """
    with _readable(path, ".npy file"), open(path, "rb") as file:
        shape, dtype = _npy_header(path, file, path.stat().st_size)
    _check_array(path, shape, dtype)
    if len(shape) == 3 and not shape[0]:
        raise DataError(f"{path}: there are no clouds")
    return shape[0] if len(shape) == 3 else None


def _npy_header(where: object, file: Any, size: int) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of numbers, after comparing them with the size of the whole in bytes."""
    version = np.lib.format.read_magic(file)
    read: Callable[..., Any] | None = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read is None:
        raise ValueError(f"version {version} of the .npy format")
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise DataError(f"{where}: a pickled array, refused; save it as plain numbers")
    expected = file.tell() + dtype.itemsize * math.prod(shape)
    if size != expected or min(shape, default=0) < 0:
        raise DataError(f"{where}: {size} bytes, expected {expected} for shape {shape}")
    return shape, dtype


def _npy(path: Path) -> CloudFile:
    return _of_array(path, read_npy(path))


def read_npy(
    path: Path, check: Callable[[tuple[int, ...], np.dtype], None] | None = None
) -> np.ndarray:
    """The array of an .npy file, of any shape and type but objects.

    Args:
        path: of the file.
        check: of shape and type, before memory is taken; raises DataError.

    Raises:
        DataError: damaged, pickled, or of another size than its header says; what `check` raises.
    """
    with _readable(path, ".npy file"), open(path, "rb") as file:
        size = path.stat().st_size
        check_memory(2 * size, path)
        shape, dtype = _npy_header(path, file, size)
        if check:
            check(shape, dtype)
        file.seek(0)
        array: np.ndarray = np.load(file, allow_pickle=False)
    return array


def _npz(path: Path) -> CloudFile:
    def choose(names: list[str]) -> list[str]:
        key = "points" if "points" in names else names[0] if len(names) == 1 else None
        if key is None:
            raise DataError(f"{path} has no array 'points'; it has {', '.join(names)}")
        return [key, *[name for name in ("cls", "label", "labels") if name in names][:1]]

    array, *labels = read_npz(path, choose).values()
    return _of_array(path, array, labels[0] if labels else None)


def read_npz(path: Path, choose: Callable[[list[str]], Sequence[str]]) -> dict[str, np.ndarray]:
    """Some arrays of an .npz, of any shape and type but objects.

    Args:
        path: of the file.
        choose: which, of the names of all; may raise DataError.

    Raises:
        DataError: damaged, pickled, or larger than `qs3.utils.memory` allows or its parts are.
    """
    arrays, needed = {}, 0
    with _readable(path, ".npz of plain arrays"), zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        for name in choose(list(members)):
            info = members[name]
            check_memory(needed := needed + 2 * info.file_size, path)
            # Whole: of a stream numpy would make the array that the header promises.
            data = archive.read(info)
            _npy_header(f"{path}, {name}", io.BytesIO(data), len(data))
            arrays[name] = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    return arrays


@contextlib.contextmanager
def _readable(path: Path, what: str) -> Iterator[None]:
    """Turn what numpy raises on damaged files, of a dozen kinds, into a DataError."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a header written by Python 2
            yield
    except DataError:
        raise
    except Exception as error:
        raise DataError(f"{path}: not a readable {what} ({error})") from error


def _ply(path: Path) -> CloudFile:
    from qs3.meshes.formats.ply import read_vertices

    try:
        return CloudFile((read_vertices(path.read_bytes()),))
    except MeshError as error:
        raise DataError(f"{path} {error}") from error


def _pcd(path: Path) -> CloudFile:
    try:
        points = read_pcd(path).xyz()
    except DataError as error:
        raise error if str(path) in str(error) else DataError(f"{path}: {error}") from error
    return CloudFile((points,))


def _hdf5(path: Path) -> CloudFile:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            data = own_dataset(file, ("data", "points"), path)
            if data is None:
                raise DataError(f"{path} has no dataset 'data' or 'points'")
            _check_array(path, data.shape, data.dtype)
            label = own_dataset(file, ("label", "labels"), path)
            check_memory(2 * data.size * data.dtype.itemsize, path)
            labels = None if label is None else _h5_labels(label, path)
            array = np.asarray(data[...])
    except (OSError, RuntimeError, ValueError, KeyError, MemoryError) as error:
        raise DataError(f"{path}: not a readable HDF5 file ({error})") from error
    return _of_array(path, array, labels)


def _h5_labels(label: Any, path: Path) -> np.ndarray:
    """[n] of a dataset of n numbers or words."""
    if label.shape is None:
        raise DataError(f"{path}: the dataset of labels is empty")
    check_memory(label.size * (label.dtype.itemsize + 50), path)
    if not label.dtype.hasobject:
        return np.asarray(label[...]).reshape(-1)
    words, size = [], 0  # of any length, and the same one may stand at many places
    for place in np.ndindex(label.shape):
        words.append(label[place])
        check_memory(size := size + len(words[-1]), path)
    found = np.empty(len(words), dtype=object)
    found[:] = words
    return found


def own_dataset(file: Any, names: tuple[str, ...], path: Path) -> Any:
    """The first of the named datasets whose numbers are in this very file; None if there is none.

    Raises:
        DataError: it takes them from other files, as HDF5 can.
    """
    import h5py

    name = next((name for name in names if name in file), None)
    if name is None:
        return None
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise DataError(f"{path}: {name!r} is a link; refused")
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise DataError(f"{path}: {name!r} is not a dataset")
    if found.external or found.is_virtual:
        raise DataError(f"{path}: {name!r} takes its numbers from other files; refused")
    return found


def _of_array(path: Path, array: np.ndarray, labels: np.ndarray | None = None) -> CloudFile:
    _check_array(path, array.shape, array.dtype)
    many = array.ndim == 3
    clouds = array[..., :3] if many else array[None, :, :3]
    if labels is not None and labels.shape != (len(clouds),):
        raise DataError(
            f"{path}: {len(clouds)} clouds, but the labels have the shape {labels.shape}"
        )
    words = None if labels is None else tuple(labels.tolist())
    return CloudFile(tuple(clouds), words, many=many)


def _check_array(path: Path, shape: tuple[int, ...] | None, dtype: np.dtype) -> None:
    if shape is None:  # of HDF5
        raise DataError(f"{path}: the dataset is empty")
    if dtype.kind not in "fiu":
        raise DataError(f"{path}: the array holds {dtype}, not numbers")
    if len(shape) not in (2, 3) or shape[-1] < 3:
        raise DataError(f"{path}: the array has shape {shape}, expected [n, 3] or [m, n, 3]")


_READERS: dict[str, Callable[[Path], CloudFile]] = {
    **{".xyz": _text, ".txt": _text, ".npy": _npy, ".npz": _npz, ".ply": _ply, ".pcd": _pcd},
    **{".h5": _hdf5, ".hdf5": _hdf5},
}
SUFFIXES: tuple[str, ...] = tuple(_READERS)
"""Suffixes of the formats that are read, in lower case."""

_SPLIT_PREFIX = re.compile(r"(train|test|val|validation)(?![a-z])", re.IGNORECASE)


def split_prefix(stem: str) -> str | None:
    """The split that the name of a file with many clouds begins with (`train_0`), if any."""
    match = _SPLIT_PREFIX.match(stem)
    return match[1].lower() if match else None
