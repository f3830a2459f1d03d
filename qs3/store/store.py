r"""Point clouds on disk: one folder a dataset, written atomically, checked whenever it is opened.

    points.npy         float32 [N, P, 3], C order, metres or the published unit; read as a memmap
    points_clean.npy   optional further arrays of the same shape (here the clean twin)
    provenance.npy     optional tables, float32 [N, P, columns]: what is known of each point
    points-00000.npy, ...  instead, where a file would exceed `array_files.SHARD_MB`
    manifest.csv       one row an object; those with status "ok" are the N clouds, in order
    meta.yaml          name, classes, hashes, and how it was made; written last

`meta.yaml` is the marker of a finished dataset: a folder without it is refused (see
`qs3.store.meta`). It holds the SHA-256 of every other file. No file holds a date, so the same
clouds
give the same bytes.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import DataError
from qs3.store.array_files import (
    SHARD_MB,
    Column,
    check_finite,
    clouds_each,
    open_array,
    shard_name,
    write_array,
)
from qs3.store.made_of import MadeOf
from qs3.store.manifest import (
    MANIFEST,
    OK,
    SPLITS,
    ManifestRow,
    check_rows,
    number,
    read_manifest,
    to_csv,
)
from qs3.store.meta import (
    META,
    is_finished,
    meta_of_finished,
    read_meta,
    sha256_of,
    write_meta,
)
from qs3.store.sharded import ShardedArray
from qs3.utils import text_table
from qs3.utils.files import make_folder, remove_leftovers, sha256_file, write_text
from qs3.utils.plural import counted
from qs3.utils.version import VERSION

__all__ = [
    "SPLITS",
    "ManifestRow",
    "PointSet",
    "counts_text",
    "evenly",
    "has_variant",
    "is_begun",
    "is_finished",
    "open_pointset",
    "open_table",
    "read_manifest",
    "read_meta",
    "write_pointset",
]


@dataclass(frozen=True, eq=False)
class PointSet:
    """A dataset in memory's terms; the clouds themselves stay on disk until they are indexed.

    Attributes:
        classes: names; a label is a position in this tuple.
        points: [N, P, 3] float32, read only (a memmap, or a copy after `split`; of a dataset in
            shards what answers like an array, also after `split`).
        labels: [N] int64; all -1 if the dataset has no labels.
        splits: [N] str.
        ids: N unique strings.
        sha256: hash of these clouds with their ids, labels and splits (of the whole dataset,
            also after `split`); goes into every result.
        meta: what meta.yaml holds.
        floor_m: z of the floor under every cloud, if a `Domain` that opened it knows.
    """

    name: str
    classes: tuple[str, ...]
    points: np.ndarray | ShardedArray
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
        """The clouds of one split, in order; a view of the memmap if they are adjacent.

        Raises:
            DataError: there are none.
        """
        chosen = self.indices(split)
        if len(chosen) == 0:
            raise DataError(
                f"dataset {self.name!r} has no split {split!r}; it has {sorted(self.counts())}"
            )
        adjacent = chosen[-1] - chosen[0] + 1 == len(chosen)
        return self.at(slice(int(chosen[0]), int(chosen[-1]) + 1) if adjacent else chosen)

    def at(self, rows: slice | np.ndarray) -> PointSet:
        """Some clouds, by their positions; the hash is still that of the whole dataset."""
        points = self.points
        return dataclasses.replace(
            self,
            points=points.at(rows) if isinstance(points, ShardedArray) else points[rows],
            labels=self.labels[rows],
            splits=self.splits[rows],
            ids=tuple(self.ids[i] for i in np.arange(len(self))[rows]),
        )

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


def is_begun(folder: str | Path) -> bool:
    """Whether something was begun in `folder` and not finished (an empty lock is nothing)."""
    folder = Path(folder)
    return (
        folder.is_dir()
        and not is_finished(folder)
        and any(path.name != ".lock" for path in folder.iterdir())
    )


def write_pointset(
    folder: str | Path,
    *,
    name: str,
    classes: Sequence[str],
    arrays: Mapping[str, np.ndarray | Sequence[np.ndarray]],
    rows: Sequence[ManifestRow],
    meta: Mapping[str, Any],
    tables: Mapping[str, Sequence[str]] | None = None,
    shard_mb: float = SHARD_MB,
) -> PointSet:
    """Write a dataset and open it again, checked.

    An older dataset in the same folder stops being finished first, so an interruption never
    leaves the new clouds under the old description. Nobody else may be writing there.

    Args:
        folder: created if need be; other files in it are left alone.
        name: of the dataset.
        classes: names in label order.
        arrays: by file stem; "points" is required. Each is [N, P, 3] or N arrays of [P, 3];
            stored as float32. A sequence that reads its clouds when asked keeps memory small: it
            is asked twice for each, to check and to write.
        rows: one an object; the k-th one with status "ok" describes cloud k.
        meta: plain values (numbers, strings, lists, dicts): sensor, renderer, versions, config.
        tables: which of the arrays are not clouds but say something of each point, with the names
            of their columns: they are [N, P, columns], and no variant to train on.
        shard_mb: no file of clouds exceeds so many MB (10^6 bytes), unless by one cloud; larger
            arrays are cut. The dataset's hash does not depend on it.

    Raises:
        DataError: arrays and rows do not fit together, or a value is not finite.
        Qs3Error: the folder cannot be written.
    """
    folder = Path(folder)
    rows, classes, tables = number(rows), tuple(classes), dict(tables or {})
    check_rows(rows, classes, where=f"rows of dataset {name!r}")
    columns = {key: Column(name, key, value) for key, value in arrays.items()}
    clouds, points = _check_arrays(name, columns, sum(row.status == OK for row in rows), tables)
    # All arrays are cut at the same clouds, where the widest has to be.
    each = min(clouds_each(shard_mb, column.shape) for column in columns.values())

    make_folder(folder)
    (folder / META).unlink(missing_ok=True)
    remove_leftovers(folder)
    written = {key: write_array(folder, key, column, each) for key, column in columns.items()}
    write_text(folder / MANIFEST, to_csv(rows))
    document = {
        "created_by": f"qs3 {VERSION}",
        "name": name,
        "classes": list(classes),
        "clouds": clouds,
        "points": points,
        "failed": len(rows) - clouds,
        "sha256": {
            **{key: one.sha256 for key, one in written.items()},
            "manifest": sha256_file(folder / MANIFEST),
        },
    }
    if clouds > each:
        hashes = {key: list(one.shards) for key, one in written.items()}
        document["shards"] = {"clouds": each, "sha256": hashes}
    if not any(row.cls for row in rows if row.status == OK):
        document["labelled"] = False
    if tables:
        document["tables"] = {key: list(columns) for key, columns in tables.items()}
    write_meta(folder, document, meta)
    return open_pointset(folder, verify=False)


def open_pointset(folder: str | Path, variant: str = "points", verify: bool = True) -> PointSet:
    """Open a dataset, checking all that can be checked in about a second.

    Args:
        folder: of the dataset.
        variant: which array, by file stem.
        verify: also compare the array's SHA-256 with meta.yaml (about 1 s for 500 MB); the
            manifest's is always compared.

    Raises:
        MissingDataError: there is no such folder, or it was not finished.
        DataError: a file is damaged or does not fit the others; names file and row.
    """
    folder = Path(folder)
    meta = meta_of_finished(folder)
    classes, hashes = tuple(meta["classes"]), meta["sha256"]
    have = sorted(set(hashes) - {"manifest", *(meta.get("tables") or {})})
    if variant not in have:
        raise DataError(
            f"{folder} holds the arrays {have}, not {variant!r}; generate the dataset again with "
            "it, or choose another variant"
        )
    rows = read_manifest(folder, classes, hashes["manifest"])
    kept = [row for row in rows if row.status == OK]
    if len(kept) != meta["clouds"]:
        raise DataError(
            f"{folder / MANIFEST} has {counted(len(kept), 'row')} with status ok, but {META} "
            f"promises {counted(meta['clouds'], 'cloud')}; generate or import the dataset again"
        )
    points = open_array(folder, variant, meta, 3, verify)
    check_finite(folder / f"{variant}.npy", points, [row.id for row in kept])
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


def has_variant(folder: str | Path, variant: str) -> bool:
    """Whether a finished dataset lies there that has this array of clouds, by its files' names."""
    return is_finished(folder) and any(
        (Path(folder) / name).is_file() for name in (f"{variant}.npy", shard_name(variant, 0))
    )


def open_table(
    folder: str | Path, name: str = "provenance"
) -> tuple[np.ndarray | ShardedArray, tuple[str, ...]]:
    """Open what a dataset knows of each point of its variant "points".

    Returns:
        [N, P, columns] float32, read only, row by row that of `PointSet.points`; and the names
        of the columns. For "provenance" see `qs3.generation.provenance.provenance_of`.

    Raises:
        MissingDataError: there is no such folder, or it was not finished.
        DataError: the dataset has no such table, or its file is damaged.
    """
    folder = Path(folder)
    meta = meta_of_finished(folder)
    tables = meta.get("tables") or {}
    if name not in tables:
        raise DataError(
            f"{folder} holds the tables {sorted(tables)}, not {name!r}; generate the dataset again "
            "with it (for provenance: provenance=true)"
        )
    columns = tuple(tables[name])
    return open_array(folder, name, meta, len(columns), verify=True), columns


def _content_hash(array: str, classes: Sequence[str], rows: Sequence[ManifestRow]) -> str:
    """Hash of what training sees: the array's bytes, and ids, classes and splits in order."""
    seen = [array, list(classes), [[row.id, row.cls, row.split] for row in rows]]
    return sha256_of(json.dumps(seen, ensure_ascii=True))


def _check_arrays(
    name: str,
    arrays: Mapping[str, Column],
    clouds: int,
    tables: Mapping[str, Sequence[str]],
) -> tuple[int, int]:
    """How many clouds of how many points, after checking that all arrays fit the manifest."""
    if "points" not in arrays:
        raise DataError(f"dataset {name!r} needs an array 'points', got {sorted(arrays)}")
    if wrong := sorted(set(tables) - set(arrays) | set(tables) & {"points"}):
        raise DataError(
            f"dataset {name!r}: tables {wrong} are not arrays beyond 'points'; arrays are "
            f"{sorted(arrays)}"
        )
    for key, array in arrays.items():
        if not key.isidentifier() or key in ("manifest", "meta"):
            raise DataError(f"an array of dataset {name!r} cannot be called {key!r}")
        width = len(tables[key]) if key in tables else 3
        if len(array.shape) != 3 or array.shape[2] != width or 0 in array.shape:
            raise DataError(
                f"array {key!r} of dataset {name!r} has shape {array.shape}, expected "
                f"[N, P, {width}] with at least one cloud of one point"
            )
        if array.shape[:2] != arrays["points"].shape[:2] or len(array) != clouds:
            raise DataError(
                f"array {key!r} of dataset {name!r} has shape {array.shape}, 'points' has "
                f"{arrays['points'].shape}, and {counted(clouds, 'row has', 'rows have')} status ok"
            )
        array.check_finite()
    n, p, _ = arrays["points"].shape
    return n, p
