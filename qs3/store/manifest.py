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
from qs3.store.meta import AGAIN
from qs3.utils.text_table import csv_text

MANIFEST = "manifest.csv"
OK = "ok"

SPLITS: tuple[str, ...] = ("train", "validation", "test")
"""The splits a manifest may name; ShapeNet10 alone has all three."""


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
    """All rows of a dataset's manifest.csv, failed ones included."""
    path = Path(folder) / MANIFEST
    try:
        data = path.read_bytes()
        rows = _from_csv(data.decode())
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{path} cannot be read ({error}); {AGAIN}") from error
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
        ok, problem = row.status == OK, ""
        unread = not ok and not row.cls  # its file did not even give the class
        if not row.id or row.id in seen:
            problem = f"the same id is already in line {seen[row.id]}" if row.id else "no id"
        elif labelled and row.cls not in classes and not unread:
            problem = f"unknown class {row.cls!r}; known are {', '.join(classes)}"
        elif row.split not in SPLITS:
            problem = f"unknown split {row.split!r}; known are {', '.join(SPLITS)}"
        elif row.index != (index if ok else None):
            problem = f"index is {row.index}, expected {index if ok else None}"
        elif not ok and not row.reason:
            problem = "an object that is not ok has a reason"
        if problem:
            raise DataError(f"{where}, line {line} (id {row.id!r}): {problem}")
        seen[row.id] = line
        index += ok


def to_csv(rows: Sequence[ManifestRow]) -> str:
    """The text of manifest.csv; line breaks inside a value become spaces."""
    more = list(dict.fromkeys(header for row in rows for header in row.more))
    lines: list[Sequence[str]] = [[*_COLUMNS, *more]]
    for row in rows:
        values = [getattr(row, name) for name in _FIELDS]
        values += [row.more.get(header) for header in more]
        lines.append(["" if v is None else " ".join(str(v).splitlines()) for v in values])
    return csv_text(lines)


def _from_csv(text: str) -> list[ManifestRow]:
    """The rows; ValueError or csv.Error if damaged, with the line."""
    header, *lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    more = header[len(_COLUMNS) :]
    if tuple(header[: len(_COLUMNS)]) != _COLUMNS or len({*header}) < len(header):
        raise ValueError("line 1: other columns")
    rows = []
    for line, values in enumerate(lines, start=2):
        try:
            fields: dict[str, Any] = dict(zip([*_FIELDS, *more], values, strict=True))
            fields |= {name: int(fields[name]) if fields[name] else None for name in _INTEGERS}
        except ValueError as error:
            raise ValueError(f"line {line}: {error}") from error
        further = {key: value for key in more if (value := fields.pop(key))}
        rows.append(ManifestRow(**fields, more=further))
    return rows
