"""What describes a dataset: meta.yaml and manifest.csv.

The last line of meta.yaml is a checksum of the others. manifest.csv has a row an object, whether it
gave a cloud or not.
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import yaml  # type: ignore[import-untyped,unused-ignore]

from qs3.errors import DataError
from qs3.utils.files import reading, write_text
from qs3.utils.text_table import csv_text

META = "meta.yaml"
MANIFEST = "manifest.csv"
OK = "ok"

SPLITS: tuple[str, ...] = ("train", "validation", "test")
"""The splits a manifest may name; ShapeNet10 alone has all three."""

FURTHER_SCAN = re.compile(r"~\d+$")
"""How the ids of an object's further scans end."""

AGAIN = "delete the folder and generate or import the dataset again"
_FORMAT = {"format": "qs3 point clouds", "format_version": 1}
_CHECKSUM = "# sha256 of the lines above: "
# A run opens its datasets some ten times, and libyaml is ten times as fast.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True, kw_only=True)
class MadeOf:
    """Whose objects a dataset shows, and what gave the points: one line next to each figure.

    Attributes:
        objects: "published files", "embedded catalogue", "meshes of cad10", "own clouds of scans".
        published: whether these are the files that were published, and all of them: what papers'
            figures were measured on.
        sensor: name of the simulated one; "surface samples" if there is none; "" if the clouds
            were not made here.
        views: of each object; 0 without a sensor, or if not known.
        without: classes of the domain that have no object, such as "lamp, plant".
        benchmark: "kinectsim10 v2", a part of it, or that it is like it, for domains with versions.
        meshes: digits that all datasets made of these very meshes share; "" if not known.
        recipe: digits that datasets made of the same objects by the same settings and code share,
            on any machine; "" if not known.
    """

    objects: str = "not known (meta.yaml does not say)"
    published: bool = False
    sensor: str = ""
    views: int = 0
    without: str = ""
    benchmark: str = ""
    meshes: str = ""
    recipe: str = ""

    # metrics.json holds it, and is read strictly: see qs3.runs.metrics.
    __pydantic_config__: ClassVar[dict[str, Any]] = {"strict": True, "extra": "forbid"}

    @staticmethod
    def of(meta: Mapping[str, Any]) -> MadeOf:
        """From a store's meta.yaml."""
        return MadeOf(**(meta.get("made_of") or {}))

    @property
    def meta(self) -> dict[str, Any]:
        """For meta.yaml."""
        return {"made_of": dataclasses.asdict(self)}

    def __str__(self) -> str:
        """Such as "embedded catalogue, speckle_stereo, 5 views"."""
        views = f"{self.views} view{'s' * (self.views > 1)}" if self.views else ""
        without = f"without {self.without}" if self.without else ""
        parts = (self.objects, self.sensor, views, without, self.benchmark)
        return ", ".join(filter(None, parts))


def is_finished(folder: str | Path) -> bool:
    """Whether `folder` holds a dataset whose writing came to its end."""
    return (Path(folder) / META).is_file()


def is_begun(folder: str | Path) -> bool:
    """Whether something was begun in `folder` and not finished (an empty lock is nothing)."""
    folder = Path(folder)
    return (
        folder.is_dir()
        and not is_finished(folder)
        and any(path.name != ".lock" for path in folder.iterdir())
    )


def write_meta(folder: Path, facts: Mapping[str, Any], others: Mapping[str, Any]) -> None:
    """Write plain values with their checksum: from here on the dataset is finished.

    Keys of `others` must not be among those of the format or of `facts`.
    """
    document = {**_FORMAT, **facts}
    assert not document.keys() & others.keys()
    text = yaml.safe_dump({**document, **others}, sort_keys=False, allow_unicode=True, width=100)
    write_text(folder / META, text + _CHECKSUM + sha256_of(text) + "\n")


def read_meta(folder: str | Path) -> dict[str, Any]:
    """The contents of a finished dataset's meta.yaml, checked against its last line."""
    path = Path(folder) / META
    with reading(path):
        text = path.read_bytes().decode()
    body, mark, checksum = text.rpartition(_CHECKSUM)
    if not mark or checksum != sha256_of(body) + "\n":
        raise DataError(f"{path} is damaged or was edited (its checksum is wrong); {AGAIN}")
    meta: dict[str, Any] = yaml.load(body, _LOADER)
    return meta


def sha256_of(text: str) -> str:
    """64 hex digits of its UTF-8 bytes."""
    return hashlib.sha256(text.encode()).hexdigest()


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
        index: row of the arrays; None if not ok.
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


def read_manifest(folder: str | Path) -> list[ManifestRow]:
    """All rows of a finished dataset's manifest.csv, failed ones included."""
    path, known = Path(folder) / MANIFEST, read_meta(folder)["sha256"]["manifest"]
    with reading(path):
        text = path.read_bytes().decode()
        assert sha256_of(text) == known, f"its SHA-256 is not the one in {META}; {AGAIN}"
    return from_csv(text)


def number(rows: Sequence[ManifestRow]) -> list[ManifestRow]:
    """The rows with `index` counted up over those with status ok."""
    indices = itertools.count()
    return [
        dataclasses.replace(row, index=next(indices) if row.status == OK else None) for row in rows
    ]


def check_rows(rows: Sequence[ManifestRow], classes: Sequence[str], name: str) -> None:
    """Raise DataError unless all ids differ, and all classes and splits are known."""
    labelled = any(row.cls for row in rows)
    ids = Counter(row.id for row in rows)
    for row in rows:
        unread = row.status != OK and not row.cls  # its file did not even give the class
        known = row.cls in classes or unread or not labelled
        if ids[row.id] > 1 or not row.id or not known or row.split not in SPLITS:
            raise DataError(f"dataset {name!r}: an id twice, or an unknown class or split: {row}")


def to_csv(rows: Sequence[ManifestRow]) -> str:
    """The text of manifest.csv; line breaks inside a value become spaces."""
    more = list(dict.fromkeys(header for row in rows for header in row.more))
    lines: list[Sequence[str]] = [[*_COLUMNS, *more]]
    for row in rows:
        values = [getattr(row, name) for name in _FIELDS]
        values += [row.more.get(header) for header in more]
        lines.append(["" if v is None else " ".join(str(v).splitlines()) for v in values])
    return csv_text(lines)


def from_csv(text: str) -> list[ManifestRow]:
    """The rows that `to_csv` wrote."""
    header, *lines = csv.reader(io.StringIO(text, newline=""))
    more, rows = header[len(_COLUMNS) :], []
    for values in lines:
        fields: dict[str, Any] = dict(zip([*_FIELDS, *more], values, strict=True))
        fields |= {name: int(fields[name]) if fields[name] else None for name in _INTEGERS}
        further = {key: value for key in more if (value := fields.pop(key))}
        rows.append(ManifestRow(**fields, more=further))
    return rows
