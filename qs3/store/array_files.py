"""The arrays of a dataset as files: one .npy, or shards of so many clouds where it gets too large.

    points.npy                               float32 [N, P, columns], C order
    points-00000.npy, points-00001.npy, ...  the same, cut along N

An array's SHA-256 is that of the single file, however it is cut: the same clouds are the same
dataset. Shards have theirs beside it, by which they are checked and a damaged one is named.
Nothing larger than a chunk of clouds is ever in memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import DataError
from qs3.store.manifest import AGAIN
from qs3.store.sharded import ShardedArray
from qs3.utils.files import atomic_path, sha256_file

SHARD_MB = 1024
"""Where a file ends by default: 41,666 clouds of 2,048 points."""

_CHUNK_CLOUDS = 512
_SHARD = re.compile(r"(?P<key>.+)-\d{5}\.npy")
_THREADS = 4  # hashing waits for the disk, and Python lets it go on meanwhile


@dataclass(frozen=True)
class Written:
    """What `write_array` left: the hash of the whole, and of each shard where there are several."""

    sha256: str
    shards: tuple[str, ...]


class Column:
    """One array of a dataset as its maker has it: in memory, or cloud by cloud from elsewhere.

    Args:
        name: of the dataset, and `key` of the array, for messages.
        value: [N, P, C], or N arrays [P, C], of which each is asked for when it is needed.

    Raises:
        DataError: the clouds of `value` have several shapes.
    """

    def __init__(self, name: str, key: str, value: np.ndarray | Sequence[np.ndarray]) -> None:
        self._where = f"array {key!r} of dataset {name!r}"
        self._value = value
        if isinstance(value, np.ndarray):
            self.shape: tuple[int, ...] = value.shape
        else:
            self.shape = (len(value), *(np.shape(value[0]) if len(value) else ()))
        if isinstance(value, (list, tuple)):
            self._check_shapes(value)

    def __len__(self) -> int:
        return self.shape[0]

    def chunks(self, most: int | None = None) -> Iterator[np.ndarray]:
        """Little-endian float32 [n, P, C] in C order, of at most so many clouds, in order.

        Raises:
            DataError: a cloud is not of the first one's shape.
        """
        most = most or _CHUNK_CLOUDS
        for start in range(0, len(self), most):
            part: Any = self._value[start : start + most]
            if not isinstance(part, np.ndarray):
                part = list(part)
                self._check_shapes(part)
            yield np.ascontiguousarray(part, dtype="<f4")

    def check_finite(self) -> None:
        """Raise DataError, which names the cloud, unless all values are finite."""
        start = 0
        for chunk in self.chunks():
            if (bad := _first_bad(chunk)) is not None:
                raise DataError(f"{self._where}: cloud {start + bad} is not finite")
            start += len(chunk)

    def _check_shapes(self, clouds: Sequence[np.ndarray]) -> None:
        if len(shapes := {self.shape[1:], *map(np.shape, clouds)}) > 1:
            raise DataError(f"{self._where} has clouds of several shapes {sorted(shapes)}")


def write_array(folder: Path, key: str, column: Column, each: int) -> Written:
    """Write an array, in shards of `each` clouds if it has more; each file atomically.

    What an older array of this name left is removed.
    """
    _remove(folder, key)
    whole = hashlib.sha256(header(column.shape))
    n, *cloud = column.shape
    if n <= each:
        path = folder / f"{key}.npy"
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            file.write(header(column.shape))
            for chunk in column.chunks():
                file.write(chunk.data.cast("B"))
                whole.update(chunk.data)
        return Written(whole.hexdigest(), ())
    hashes = []
    chunks = column.chunks(min(each, _CHUNK_CLOUDS))
    rest = np.empty((0, *cloud), dtype="<f4")
    for number, start in enumerate(range(0, n, each)):
        wanted = min(each, n - start)
        own = hashlib.sha256(head := header((wanted, *cloud)))
        path = folder / shard_name(key, number)
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            file.write(head)
            while wanted:
                if not len(rest):
                    rest = next(chunks)
                part, rest = rest[:wanted], rest[wanted:]
                file.write(part.data.cast("B"))
                own.update(part.data)
                whole.update(part.data)
                wanted -= len(part)
        hashes.append(own.hexdigest())
    return Written(whole.hexdigest(), tuple(hashes))


def open_array(
    folder: Path, key: str, meta: Mapping[str, Any], columns: int, verify: bool
) -> np.ndarray | ShardedArray:
    """[N, P, columns] float32 memmaps; headers, sizes and hashes must be what they were.

    Raises:
        DataError: names the file that is damaged.
    """
    n, p, sharded = meta["clouds"], meta["points"], meta.get("shards")
    found: np.ndarray | ShardedArray
    if sharded is None:
        found = _open_file(folder / f"{key}.npy", (n, p, columns))
        files = {folder / f"{key}.npy": meta["sha256"][key]}
    else:
        each, hashes = sharded["clouds"], sharded["sha256"][key]
        names = [folder / shard_name(key, i) for i in range(len(hashes))]
        files = dict(zip(names, hashes, strict=True))
        found = ShardedArray(
            [
                _open_file(path, (min(each, n - i * each), p, columns))
                for i, path in enumerate(files)
            ]
        )
    if verify:
        for path, sha256 in zip(files, _hashes(list(files)), strict=True):
            if sha256 != files[path]:
                raise DataError(
                    f"{path} is damaged (its SHA-256 is not the one in meta.yaml); {AGAIN}"
                )
    return found


def check_finite(where: Path, points: np.ndarray | ShardedArray, ids: Sequence[str]) -> None:
    """Raise DataError, which names the cloud, unless all values are finite."""
    for start in range(0, len(points), _CHUNK_CLOUDS):
        bad = _first_bad(np.asarray(points[start : start + _CHUNK_CLOUDS]))
        if bad is not None:
            bad += start
            raise DataError(f"{where}, cloud {bad} (id {ids[bad]!r}) is not finite; {AGAIN}")


def shards_fit(sharded: Any, clouds: int, keys: set[str]) -> bool:
    """Whether this is what `write_array` leaves of these arrays, of so many clouds.

    None: of no array there are shards.
    """
    if sharded is None:
        return True
    if not isinstance(sharded, dict) or set(sharded) != {"clouds", "sha256"}:
        return False
    each, hashes = sharded["clouds"], sharded["sha256"]
    if type(each) is not int or each < 1 or not isinstance(hashes, dict) or set(hashes) != keys:
        return False
    return all(
        isinstance(some, list) and len(some) == -(-clouds // each) and all(map(_word, some))
        for some in hashes.values()
    )


def clouds_each(shard_mb: float, shape: tuple[int, ...]) -> int:
    """How many clouds of an array [N, P, C] a file holds, of at most so many MB; at least one."""
    return max(1, int(1e6 * shard_mb / (4 * math.prod(shape[1:]))))


def shard_name(key: str, number: int) -> str:
    """Of a file."""
    return f"{key}-{number:05d}.npy"


def header(shape: tuple[int, ...]) -> bytes:
    """The .npy header of a float32 C-order array: the only one this format has."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": "<f4", "fortran_order": False, "shape": shape}
    )
    return file.getvalue()


def _open_file(path: Path, shape: tuple[int, int, int]) -> np.ndarray:
    head = header(shape)
    expected = len(head) + 4 * math.prod(shape)
    try:
        with open(path, "rb") as file:
            found = file.read(len(head))
        size = path.stat().st_size
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); {AGAIN}") from error
    if size != expected:
        raise DataError(f"{path} has {size} bytes, expected {expected} for {shape}; {AGAIN}")
    if found != head:
        raise DataError(f"{path} does not have the header of a float32 array {shape}; {AGAIN}")
    return np.memmap(path, dtype="<f4", mode="r", offset=len(head), shape=shape)


def _hashes(paths: Sequence[Path]) -> Iterable[str]:
    if len(paths) == 1:
        return [sha256_file(paths[0])]
    # Here, because its import fails in a process that is ending, where sweeps are summarised.
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(_THREADS) as threads:
        return list(threads.map(sha256_file, paths))


def _remove(folder: Path, key: str) -> None:
    for path in folder.glob(f"{key}*.npy"):
        match = _SHARD.fullmatch(path.name)
        if path.name == f"{key}.npy" or (match and match["key"] == key):
            with contextlib.suppress(FileNotFoundError):
                path.unlink()


def _first_bad(clouds: np.ndarray) -> int | None:
    finite = np.isfinite(clouds).all(axis=(1, 2))
    return None if finite.all() else int(np.flatnonzero(~finite)[0])


def _word(value: Any) -> bool:
    return isinstance(value, str)
