r"""Point clouds on disk: one folder a dataset, written atomically, checked whenever it is opened.

    points.npy         float32 [N, P, 3], C order, metres or the published unit; read as a memmap
    points_clean.npy   optional further arrays of the same shape (here the clean twin)
    provenance.npy     optional tables, float32 [N, P, columns]: what is known of each point of
                       points.npy; meta.yaml names the columns
    manifest.csv       one row an object; those with status "ok" are the N clouds, in order
    meta.yaml          name, classes, hashes, and how it was made; written last

`meta.yaml` is the marker of a finished dataset: a folder without it is refused (see
`qs3.store.meta`). It holds the SHA-256 of every other file. No file holds a date, so the same
clouds give the same bytes.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import DataError
from qs3.store.meta import (
    AGAIN,
    MANIFEST,
    META,
    OK,
    SPLITS,
    MadeOf,
    ManifestRow,
    check_rows,
    number,
    read_manifest,
    read_meta,
    sha256_of,
    to_csv,
    write_meta,
)
from qs3.utils import text_table
from qs3.utils.files import (
    atomic_path,
    make_folder,
    reading,
    remove_leftovers,
    sha256_file,
    write_text,
)
from qs3.utils.version import VERSION

_CHUNK_CLOUDS = 512  # that are in memory at a time

HEIGHTS = ("above_floor", "seen")
"""Scales (`data.scale`) at which a net sees how high above the floor clouds are."""

Clouds = np.ndarray | Sequence[np.ndarray]
"""[N, P, C], or N arrays [P, C], each of which is asked for when it is needed."""


@dataclass(frozen=True, eq=False)
class PointSet:
    """A dataset in memory's terms; the clouds themselves stay on disk until they are indexed.

    Attributes:
        classes: names; a label is a position in this tuple.
        points: [N, P, 3] float32, read only: a memmap, or a copy after `split`.
        labels: [N] int64; all -1 if the dataset has no labels.
        splits: [N] str.
        ids: N unique strings.
        sha256: hash of these clouds with their ids, labels and splits (of the whole dataset,
            also after `split`); goes into every result.
        meta: what meta.yaml holds.
        floor_m: z of the floor under every cloud, if the `Domain` that opened it gives it.
    """

    name: str
    classes: tuple[str, ...]
    points: np.ndarray
    labels: np.ndarray
    splits: np.ndarray
    ids: tuple[str, ...]
    sha256: str
    meta: Mapping[str, Any]
    floor_m: float | None = None

    def __len__(self) -> int:
        """N."""
        return len(self.labels)

    @property
    def labelled(self) -> bool:
        """Whether the classes of the clouds are known."""
        return bool((self.labels >= 0).all())

    @property
    def made_of(self) -> MadeOf:
        """Whose objects these are, and what gave the points."""
        return MadeOf.of(self.meta)

    def indices(self, split: str) -> np.ndarray:
        """[n] int64 positions of a split's clouds, in the dataset's order."""
        return np.flatnonzero(self.splits == split)

    def members(self, cls: str) -> np.ndarray:
        """[n] int64 positions of a class's clouds; none of a name that is not a class here."""
        known = cls in self.classes
        return np.flatnonzero(self.labels == self.classes.index(cls) if known else [])

    def split(self, split: str) -> PointSet:
        """The clouds of one split, in order; a view of the memmap if they are adjacent."""
        chosen = self.indices(split)
        if len(chosen) == 0:
            raise DataError(f"dataset {self.name!r} has no split {split!r}")
        adjacent = chosen[-1] - chosen[0] + 1 == len(chosen)
        return self.at(slice(int(chosen[0]), int(chosen[-1]) + 1) if adjacent else chosen)

    def at(self, rows: slice | np.ndarray) -> PointSet:
        """Some clouds, by their positions; the hash is still that of the whole dataset."""
        return dataclasses.replace(
            self,
            points=self.points[rows],
            labels=self.labels[rows],
            splits=self.splits[rows],
            ids=tuple(self.ids[i] for i in np.arange(len(self))[rows]),
        )

    def fewer(self, count: int) -> PointSet:
        """At most `count` clouds of each split, at even steps, in order; for `debug=fast`."""
        chosen = [evenly(self.indices(split), count) for split in self.counts()]
        return self.at(np.sort(np.concatenate(chosen)))

    def counts(self) -> dict[str, dict[str, int]]:
        """Clouds by split and class, zeros included; only splits that occur."""
        return {
            split: {
                name: int(np.sum((self.splits == split) & (self.labels == label)))
                for label, name in enumerate(self.classes)
            }
            for split in SPLITS
            if np.any(self.splits == split)
        }


def evenly(positions: np.ndarray, most: int) -> list[int]:
    """At most so many of some positions [n], at even steps from the first on."""
    few = min(most, len(positions))
    return [int(positions[i * len(positions) // few]) for i in range(few)]


def counts_text(data: PointSet, without: str, missing: Mapping[str, int]) -> list[str]:
    """Lines of a table for the log: clouds by class and split, and objects without one.

    Those are counted by class in `missing`, under the heading `without`, such as "failed".
    """
    counts = data.counts()
    rows = [["clouds", *counts, without]]
    numbers = {name: [*(of[name] for of in counts.values()), missing.get(name, 0)]
               for name in data.classes}  # fmt: skip
    rows += [[name, *map(str, of)] for name, of in numbers.items() if any(of)]
    total = (str(sum(column)) for column in zip(*numbers.values(), strict=True))
    return text_table.aligned([*rows, ["all", *total]], numbers=True, rule=False)


def write_pointset(
    folder: str | Path,
    *,
    name: str,
    classes: Sequence[str],
    arrays: Mapping[str, Clouds],
    rows: Sequence[ManifestRow],
    meta: Mapping[str, Any],
    tables: Mapping[str, Sequence[str]] | None = None,
) -> PointSet:
    """Write a dataset and open it again, checked.

    An older dataset in the same folder stops being finished first, so an interruption never
    leaves the new clouds under the old description. Nothing else may be writing there.

    Args:
        folder: created if need be; other files in it are left alone.
        arrays: by file stem; "points" is required. Each is [N, P, 3] or N arrays of [P, 3];
            stored as float32. A sequence that reads its clouds when asked keeps memory small: it
            is asked twice for each, to check and to write.
        rows: one an object; the k-th one with status "ok" describes cloud k.
        meta: plain values (numbers, strings, lists, dicts): sensor, renderer, versions, config.
        tables: which of the arrays are not clouds but say something of each point, with the names
            of their columns: they are [N, P, columns], and no variant to train on.

    Raises:
        DataError: arrays and rows do not fit together, or a value is not finite.
        Qs3Error: the folder cannot be written.
    """
    folder = Path(folder)
    rows, classes, tables = number(rows), tuple(classes), dict(tables or {})
    check_rows(rows, classes, name)
    clouds = sum(row.status == OK for row in rows)
    points = _shape(arrays["points"])[1] if clouds else 0
    for key, array in arrays.items():
        columns = len(tables[key]) if key in tables else 3
        where, shape = f"array {key!r} of dataset {name!r}", (clouds, points, columns)
        if _shape(array) != shape or not points:
            raise DataError(f"{where} has shape {_shape(array)}, expected {shape}")
        for start, chunk in enumerate(_chunks(array, where)):
            if (bad := _first_bad(chunk)) is not None:
                at = start * _CHUNK_CLOUDS + bad
                raise DataError(f"{where}: cloud {at} is not finite")

    make_folder(folder)
    (folder / META).unlink(missing_ok=True)
    remove_leftovers(folder)
    hashes = {key: _write_array(folder / f"{key}.npy", array) for key, array in arrays.items()}
    write_text(folder / MANIFEST, to_csv(rows))
    document = {
        "created_by": f"qs3 {VERSION}",
        "name": name,
        "classes": list(classes),
        "clouds": clouds,
        "points": points,
        "failed": len(rows) - clouds,
        "sha256": {**hashes, "manifest": sha256_file(folder / MANIFEST)},
    }
    if not any(row.cls for row in rows if row.status == OK):
        document["labelled"] = False
    if tables:
        document["tables"] = {key: list(columns) for key, columns in tables.items()}
    write_meta(folder, document, meta)
    return open_pointset(folder, verify=False)


def open_pointset(folder: str | Path, variant: str = "points", verify: bool = True) -> PointSet:
    """Open a dataset, checking all that can be checked in about a second.

    `variant` is the file stem of the array. With `verify` its SHA-256 is compared, too (about 1 s
    for 500 MB); the manifest's always is.

    Raises:
        MissingDataError: the folder does not exist, or was not finished.
        DataError: a file is damaged or does not fit the others; names file and row.
    """
    folder = Path(folder)
    meta = read_meta(folder)
    classes, hashes = tuple(meta["classes"]), meta["sha256"]
    have = sorted(set(hashes) - {"manifest", *(meta.get("tables") or {})})
    if variant not in have:
        raise DataError(f"{folder} holds the arrays {have}, not {variant!r}: generate it again")
    rows = read_manifest(folder)
    kept = [row for row in rows if row.status == OK]
    points = _open_array(folder, variant, meta, verify)
    for start in range(0, len(points), _CHUNK_CLOUDS):
        if (bad := _first_bad(points[start : start + _CHUNK_CLOUDS])) is not None:
            where = f"{folder / variant}.npy, cloud {start + bad} (id {kept[start + bad].id!r})"
            raise DataError(f"{where} is not finite; {AGAIN}")
    position = {name: label for label, name in enumerate(classes)}
    return PointSet(
        name=meta["name"],
        classes=classes,
        points=points,
        labels=np.array([position.get(row.cls, -1) for row in kept], dtype=np.int64),
        splits=np.array([row.split for row in kept], dtype=np.str_),
        ids=tuple(row.id for row in kept),
        sha256=_content_hash(hashes[variant], classes, kept),
        meta=meta,
    )


def _content_hash(array: str, classes: Sequence[str], rows: Sequence[ManifestRow]) -> str:
    """Hash of what training sees: the array's bytes, and ids, classes and splits in order."""
    seen = [array, list(classes), [[row.id, row.cls, row.split] for row in rows]]
    return sha256_of(json.dumps(seen, ensure_ascii=True))


def _shape(clouds: Clouds) -> tuple[int, ...]:
    if isinstance(clouds, np.ndarray):
        return clouds.shape
    return (len(clouds), *(np.shape(clouds[0]) if len(clouds) else (0, 0)))


def _chunks(clouds: Clouds, where: str) -> Iterator[np.ndarray]:
    """Little-endian float32 [n, P, C] in C order, in order; DataError if shapes differ."""
    for start in range(0, len(clouds), _CHUNK_CLOUDS):
        try:
            yield np.ascontiguousarray(clouds[start : start + _CHUNK_CLOUDS], dtype="<f4")
        except ValueError as error:
            raise DataError(f"{where} has clouds of several shapes ({error})") from error


def _write_array(path: Path, clouds: Clouds) -> str:
    """Write an array, atomically; returns its file's SHA-256."""
    header = {"descr": "<f4", "fortran_order": False, "shape": _shape(clouds)}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for chunk in _chunks(clouds, str(path)):
            file.write(chunk.data.cast("B"))
    return sha256_file(path)


def _open_array(folder: Path, key: str, meta: Mapping[str, Any], verify: bool) -> np.ndarray:
    """[N, P, 3] float32 memmap whose layout, size and hash are what they were."""
    path, shape = folder / f"{key}.npy", (meta["clouds"], meta["points"], 3)
    with reading(path):
        array = np.lib.format.open_memmap(path, mode="r")
        size = array.offset + array.nbytes
        found = array.shape, array.dtype, array.flags.c_contiguous, size
        assert found == (shape, np.dtype("<f4"), True, path.stat().st_size), AGAIN
        if verify:
            assert sha256_file(path) == meta["sha256"][key], f"another SHA-256; {AGAIN}"
    return array


def _first_bad(clouds: np.ndarray) -> int | None:
    finite = np.isfinite(clouds).all(axis=(1, 2))
    return None if finite.all() else int(np.flatnonzero(~finite)[0])
