"""The list of a dataset's objects, manifest.csv: one row each, whether it gave a cloud or not."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from qs3.errors import DataError
from qs3.utils.memory import TABLE_PEAK, read_whole
from qs3.utils.plural import counted
from qs3.utils.text_table import csv_text

MANIFEST = "manifest.csv"
OK = "ok"

SPLITS: tuple[str, ...] = ("train", "validation", "test")
"""The splits a manifest may name; ShapeNet10 alone has all three."""

AGAIN = "delete the folder and generate or import the dataset again"


@dataclass(frozen=True)
class ManifestRow:
    """One object of a dataset, whether it gave a cloud or not.

    Attributes:
        id: unique in the dataset, e.g. "chair/train/chair_0007".
        cls: class name (column `class`); empty in all rows of a dataset without labels,
            and where a cloud was left out before its class was known.
        split: one of `SPLITS`.
        seed: the object's own seed; None for published clouds.
        mesh_sha256: hash of the mesh it was made from; empty for published clouds.
        origin: where it comes from, for a human: a file name or a family of the catalogue.
        views: number of views fused; None if not known.
        valid_points: number of measured points before sampling to P; for an imported cloud the
            number of rows in its file (fewer than P: the rest repeats them).
        status: "ok", or a word for what went wrong ("failed", "skipped").
        reason: why it is not ok; of one that is, what was left out of its file, if anything.
        index: row of the arrays; set by `write_pointset`, None if not ok.
        more: further columns of this dataset alone, by header: sensor, tier, frame. A manifest
            has them only if a row does, so others keep their bytes.
    """

    id: str
    cls: str
    split: str
    seed: int | None = None
    mesh_sha256: str = ""
    origin: str = ""
    views: int | None = None
    valid_points: int | None = None
    status: str = OK
    reason: str = ""
    index: int | None = None
    more: Mapping[str, str] = field(default_factory=dict, hash=False)


_COLUMNS = (
    *("index", "id", "class", "split", "seed", "mesh_sha256"),
    *("origin", "views", "valid_points", "status", "reason"),
)
_FIELDS = tuple("cls" if column == "class" else column for column in _COLUMNS)
_INTEGERS = ("index", "seed", "views", "valid_points")


def read_manifest(
    folder: str | Path, classes: Sequence[str], sha256: str | None = None
) -> list[ManifestRow]:
    """All rows of a dataset's manifest.csv, failed ones included.

    Raises:
        DataError: a row is wrong (names the line), or the hash is not `sha256`, if that is given.
    """
    path = Path(folder) / MANIFEST
    try:
        data = read_whole(path, TABLE_PEAK)
        text = data.decode()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read ({error}); {AGAIN}") from error
    rows = _from_csv(text, path)
    check_rows(rows, tuple(classes), where=str(path))
    if sha256 is not None and hashlib.sha256(data).hexdigest() != sha256:
        raise DataError(
            f"{path} is damaged or was edited (its SHA-256 is not the one in meta.yaml)"
        )
    return rows


def number(rows: Sequence[ManifestRow]) -> list[ManifestRow]:
    """The rows with `index` counted up over those with status ok."""
    numbered, index = [], 0
    for row in rows:
        ok = row.status == OK
        numbered.append(dataclasses.replace(row, index=index if ok else None))
        index += ok
    return numbered


def check_rows(rows: Sequence[ManifestRow], classes: tuple[str, ...], where: str) -> None:
    """Raise DataError at the first row that contradicts the others or the classes."""
    seen: dict[str, int] = {}
    index = 0
    labelled = any(row.cls for row in rows)
    for line, row in enumerate(rows, start=2):  # line 1 of the file is the header
        at = f"{where}, line {line} (id {row.id!r})"
        if not row.id:
            raise DataError(f"{at}: the id is empty")
        if row.id in seen:
            raise DataError(f"{at}: the same id is already in line {seen[row.id]}")
        seen[row.id] = line
        unread = row.status != OK and not row.cls  # its file could not even tell the class
        if labelled and row.cls not in classes and not unread:
            raise DataError(f"{at}: unknown class {row.cls!r}; known are {', '.join(classes)}")
        if row.split not in SPLITS:
            raise DataError(f"{at}: unknown split {row.split!r}; known are {', '.join(SPLITS)}")
        if row.status == OK:
            if row.index != index:
                raise DataError(f"{at}: index is {row.index}, expected {index}")
            index += 1
        elif row.index is not None or not row.reason:
            raise DataError(f"{at}: an object that is not ok has no index and has a reason")


def to_csv(rows: Sequence[ManifestRow]) -> str:
    """The text of manifest.csv; line breaks inside a value become spaces."""
    more = list(dict.fromkeys(header for row in rows for header in row.more))
    lines: list[Sequence[str]] = [[*_COLUMNS, *more]]
    for row in rows:
        values = [getattr(row, name) for name in _FIELDS]
        values += [row.more.get(header) for header in more]
        lines.append(["" if v is None else " ".join(str(v).splitlines()) for v in values])
    return csv_text(lines)


def _from_csv(text: str, path: Path) -> list[ManifestRow]:
    try:
        header, *lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    except (csv.Error, ValueError) as error:
        raise DataError(f"{path} is empty or damaged ({error}); {AGAIN}") from error
    more = header[len(_COLUMNS) :]
    if tuple(header[: len(_COLUMNS)]) != _COLUMNS or len({*header}) < len(header):
        raise DataError(f"{path}, line 1: the columns are not {', '.join(_COLUMNS)}")
    rows = []
    for number, values in enumerate(lines, start=2):
        if len(values) != len(header):
            has = counted(len(values), "column")
            raise DataError(f"{path}, line {number}: {has}, not {len(header)}")
        fields: dict[str, Any] = {}
        for name, value in zip(_FIELDS, values, strict=False):
            try:
                fields[name] = (int(value) if value else None) if name in _INTEGERS else value
            except ValueError as error:
                where = f"{path}, line {number}"
                raise DataError(f"{where}: {name} is {value!r}, not a number") from error
        further = zip(more, values[len(_COLUMNS) :], strict=True)
        rows.append(ManifestRow(**fields, more={key: value for key, value in further if value}))
    return rows
