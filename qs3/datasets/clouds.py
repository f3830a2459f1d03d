"""Point clouds of any number of points from files in the usual formats.

    .xyz .txt   text, a row a point: x y z and perhaps more columns, by blanks, commas or
                semicolons, with decimal points or commas; # and // begin a comment. A first row
                of names gives the columns x, y and z, also as a comment
    .npy        [n, >= 3], or [m, n, >= 3]: m clouds; or [n] or [m, n] of records x, y, z
    .npz        the array `points` (or the only one) as in .npy; perhaps `label` or `cls`
    .ply        the vertices, text or binary; faces are passed over
    .pcd        x y z
    .h5 .hdf5   the dataset `data` or `points` as in .npy; perhaps `label`

Only x y z are read. Pickled arrays are refused unopened.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.errors import DataError
from qs3.utils.files import reading

NOTHING = "NaN, infinite or (0, 0, 0)"
"""What stands for no measurement, for messages."""

_XYZ = ["x", "y", "z"]
_USUAL = {  # names of columns in comments, which may be about anything
    *("x", "y", "z", "r", "g", "b", "a", "rgb", "rgba", "red", "green", "blue", "alpha", "i"),
    *("intensity", "reflectance", "id", "index", "point", "label", "class", "t", "time"),
    *("timestamp", "ring", "nx", "ny", "nz", "normal_x", "normal_y", "normal_z", "curvature"),
}
_DECIMAL_COMMA = re.compile(r"[-+]?(\d+,\d+|\d*\.?\d*)([eE][-+]?\d+)?")
_ENDS = ",; \t"  # of a row
_MOST_COLUMNS = 32  # x y z, normals, colours and what else programs write; a picture has more
_FEW = 10  # more columns than that in three rows: points stand in columns
_PICTURES = {
    *((240, 320), (480, 640), (424, 512), (576, 640), (270, 480), (360, 640), (480, 848)),
    *((540, 960), (720, 1280), (960, 1280), (1080, 1920)),
}
"""Height and width of depth cameras' pictures; so many clouds of so many points are not likely."""
_MOST = 1e18  # of a coordinate: squares of distances overflow in float32 from about 1e19 on
_FINE = 2.0**-13  # of the cloud, that a step of float32 may be: 0.1 mm of a chair


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
    """All clouds of a file, with the numbers that it holds.

    Raises:
        DataError: names the file.
    """
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


def npy_clouds(path: Path) -> int | None:
    """How many clouds an .npy file is made for, without reading them; None: a single one."""
    with reading(path):
        found = _of_array(np.load(path, mmap_mode="r", allow_pickle=False))
    return len(found.clouds) if found.many else None


def read_arrays(
    path: Path, required: Sequence[str], optional: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Some arrays of an .npz; nothing in it is unpickled."""
    with reading(path), open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
        return {key: file[key] for key in (*required, *(k for k in optional if k in file))}


def read_pcd(path: Path) -> Float[np.ndarray, "h w 3"]:
    """Positions of a PCD file, NaN where nothing was measured; h is 1 unless it is organised."""
    from pypcd4 import PointCloud

    with reading(path):
        cloud = PointCloud.from_path(path)
        xyz = cloud.numpy(tuple(_XYZ)).astype(np.float64)
        return xyz.reshape(cloud.metadata.height, cloud.metadata.width, 3)


def check_shape(where: Any, shape: tuple[int, ...]) -> None:
    """Refuse an array of numbers whose rows cannot be points.

    Args:
        where: for the message: its file.
        shape: [n, >= 3], a point a row with perhaps more columns; or [m, n, >= 3], m clouds.

    Raises:
        DataError: transposed (x y z are rows), or rather a depth image; begins with `where`.
    """
    rows, columns = shape[-2:] if len(shape) in (2, 3) else (0, 0)
    picture = columns > _MOST_COLUMNS or (len(shape) == 3 and shape[:2] in _PICTURES)
    if columns < 3 or picture or (rows == 3 and columns > _FEW):
        raise DataError(
            f"{where}: shape {shape}, expected points as rows, [n, 3] or [m, n, 3]; give a depth "
            "image as depth=, and one organised cloud as cloud.reshape(-1, 3)"
        )


def with_depth(cloud: np.ndarray, where: str) -> tuple[np.ndarray, int]:
    """[n, 3] without the points that stand for no measurement, and how many these were.

    Depth cameras write NaN, infinity or (0, 0, 0) for a pixel that saw nothing. One point that is
    exactly (0, 0, 0) stays: a shape about the origin may have it. Several can only stand for
    nothing, or are one point of a cloud in whole millimetres.

    Raises:
        DataError: no point is left.
    """
    kept = np.isfinite(cloud).all(axis=1)
    nothing = (cloud == 0).all(axis=1)
    if nothing.sum() > 1:
        kept &= ~nothing
    if not kept.any():
        raise DataError(f"{where}: all {len(cloud)} points are {NOTHING}: nothing was measured")
    return (cloud if kept.all() else cloud[kept]), int((~kept).sum())


def checked(cloud: np.ndarray, where: str) -> Float[np.ndarray, "n 3"]:
    """[n, 3] of any numbers to float32.

    A map's coordinates are so far from their origin that float32 has steps of decimetres there.
    Where x or y are too far from 0 for float32's steps they are moved there: no classifier sees
    where a cloud lies, but z is its height.

    Raises:
        DataError: no points, a value that is not finite in float32, or above 1e18, where distances
            are not; z too far from 0, or numbers that have lost their digits already.
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
    lost = cloud.dtype.kind == "f" and cloud.dtype.itemsize < 8
    if lost or coarse[2]:
        raise DataError(
            f"{where}: its coordinates, up to {np.abs(small).max():.7g}, are too large for the "
            f"digits of float32, and the cloud is only {extent:.3g} large; subtract an offset"
        )
    return (np.asarray(cloud, np.float64) - np.where(coarse, (low + high) / 2, 0)).astype(
        np.float32
    )


def read_text(path: Path) -> Float[np.ndarray, "n 3"]:
    """Coordinates of all rows, float64: the columns named x, y and z, else the first three."""
    text = path.read_bytes().decode("utf-8-sig", "replace").replace("//", "#")
    lines, names = _named(text.splitlines())
    rows = [row for line in lines if (row := line.split("#")[0].strip())]
    first = rows[0] if rows else ""
    separator = _separator(first)
    if separator == "decimal comma":
        rows = [row.replace(",", ".").replace(";", " ") for row in rows]
        separator = None
    elif separator:
        rows = [row.rstrip(_ENDS) for row in rows]
    table = np.loadtxt(rows, dtype=np.float64, ndmin=2, delimiter=separator, comments=None)
    check_shape(path, table.shape)
    if len(names) == table.shape[1]:
        return table[:, [names.index(axis) for axis in _XYZ]]
    if names and names[:3] != _XYZ:  # x would be an id, or a colour
        raise ValueError(
            f"its first row names {len(names)} columns, the others have another number"
        )
    return table[:, :3]


def _separator(row: str) -> str | None:
    """What stands between the numbers of a row; None: blanks."""
    row = row.rstrip(_ENDS)
    together = re.sub(r"[ \t]*,[ \t]*", ",", row)
    if "," in row and not re.search(r"[;\s]", together):
        mixed = bool(re.search(r",[ \t]", row) and re.search(r"\d,\d", row)) and "." not in row
        words = [] if mixed else together.split(",")
    elif "," in row or ";" in row:
        words = re.split(r"[;\s]+", row)
        if all(map(_DECIMAL_COMMA.fullmatch, words)):
            return "decimal comma"
        words = []
    else:
        return None
    if len(words) < 3:
        raise ValueError(f"{row[:60]!r}: do its commas stand between numbers or within them?")
    return ","


def _named(lines: list[str]) -> tuple[list[str], list[str]]:
    """The lines without a first row of names; and the names, if there are any.

    A comment before all rows may have them as well, if it has no other words.
    """
    for number, line in enumerate(lines):
        begin = line.strip()
        names = _names(begin.lstrip("#"))
        if begin.startswith("#") or not begin:
            if names and _USUAL.issuperset(names):
                return lines[number + 1 :], names
            continue
        return (lines[number + 1 :], names) if names else (lines[number:], [])
    return [], []


def _names(line: str) -> list[str]:
    """The words, in small letters, if x, y and z are each among them once; else none."""
    words = [word.strip('"').lower() for word in re.findall(r"[^,;\s]+", line)]
    return words if all(words.count(axis) == 1 for axis in _XYZ) else []


def _text(path: Path) -> CloudFile:
    return CloudFile((read_text(path),))


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
    return CloudFile((read_pcd(path).reshape(-1, 3),))


def _hdf5(path: Path) -> CloudFile:
    import h5py

    with h5py.File(path, "r") as file:
        data = file["data"] if "data" in file else file["points"]
        label = next((file[key] for key in ("label", "labels") if key in file), None)
        return _of_array(data[...], None if label is None else np.asarray(label[...]).reshape(-1))


def _of_array(array: np.ndarray, labels: np.ndarray | None = None) -> CloudFile:
    if array.dtype.names:
        fields = {name.lower(): name for name in array.dtype.names}
        array = np.stack([array[fields[axis]] for axis in _XYZ], axis=-1)
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
