"""Which object of a scene is of which of the ten classes.

Three files say so. `<scene>.aggregation.json` lists the objects, each with an `objectId` (from 0)
and a label in the annotators' words. `scannetv2-labels.combined.tsv` maps these words
(`raw_category`) to tidied ones (`category`: plurals, misspellings and synonyms gone) and to a
number (`id`). In the masks a pixel of the instance image is `objectId` + 1 and one of the label
image the `id` of the object's label; 0 is unannotated in both. (The tool that draws the masks
writes the `id` of the aggregation's group + 1: the same number; where it is not, it is noted.)

PointDA-10 takes the objects whose label is one of ten names, exactly: `NAMES`. So a "bookshelf" is
none of its shelves and a "sofa" only a couch if the label map says so.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from qs3.classes import ALIASES, CLASSES
from qs3.errors import DataError, MissingDataError
from qs3.utils.memory import JSON_PEAK, read_whole
from qs3.utils.plural import counted

NAMES: tuple[str, ...] = (
    "bathtub", "bed", "shelf", "cabinet", "chair", "lamp", "monitor", "plant", "couch", "table",
)  # fmt: skip
"""ScanNet's names of the ten classes, in the order of PointDA-10 (PointDAN's class list)."""

COLUMNS = ("category", "raw_category")

_CLASS_OF = {name: ALIASES.get(name, name) for name in NAMES}
_MAX_ID = 65535  # of a 16-bit mask


@dataclass(frozen=True)
class LabelMap:
    """The label map, as far as the ten classes need it.

    Attributes:
        class_of_label: annotator's word to class; words of no class are left out.
        class_of_id: number in a label mask to class; other numbers are left out.
    """

    class_of_label: Mapping[str, str]
    class_of_id: Mapping[int, str]


@dataclass(frozen=True)
class Labelled:
    """An object of one of the ten classes.

    Attributes:
        object_id: `objectId` of the aggregation; its mask's pixels are this + 1.
        label: the annotators' word.
        cls: one of `qs3.classes.CLASSES`.
    """

    object_id: int
    label: str
    cls: str


def read_label_map(path: str | Path, column: str = "category") -> LabelMap:
    """Read scannetv2-labels.combined.tsv (or ScanNet v1's, whose `category` is the raw word).

    `column` has the words that are compared with `NAMES`: "category" (tidied) or "raw_category".

    Raises:
        MissingDataError: there is no such file.
        DataError: it has other columns, or none of the ten names.
    """
    lines = _text(path, "the label map").splitlines()
    reader = csv.DictReader(lines, delimiter="\t", quoting=csv.QUOTE_NONE)
    header = reader.fieldnames or []
    raw = "raw_category" if "raw_category" in header else "category"
    if missing := sorted({"id", raw, column} - set(header)):
        raise DataError(
            f"{path}: there are no columns {missing}; is it scannetv2-labels.combined.tsv?"
        )
    by_label, by_id = {}, {}
    try:
        for line, row in enumerate(reader, start=2):
            cls = _CLASS_OF.get((row[column] or "").strip())
            if cls is None:
                continue
            number = (row["id"] or "")[:20]  # Python reads no more than 4300 digits
            if not number.isdecimal() or not 1 <= int(number) <= _MAX_ID:
                raise DataError(f"{path}, line {line}: the id is {number!r}, not 1 to {_MAX_ID}")
            by_label[(row[raw] or "").strip()] = cls
            by_id[int(number)] = cls
    except csv.Error as error:
        raise DataError(f"{path}: {error}") from error
    if absent := sorted(set(CLASSES) - set(by_label.values())):
        raise DataError(f"{path}: no label of the classes {', '.join(absent)} in {column!r}")
    return LabelMap(by_label, by_id)


def read_objects(path: str | Path, label_map: LabelMap) -> tuple[list[Labelled], list[str]]:
    """The objects of the ten classes in an aggregation.json, by `objectId`, and what is odd.

    Odd is the same `objectId` under labels of different classes (such an object is left out), and
    another `id` than `objectId`.

    Raises:
        DataError: it is not an aggregation.
    """
    try:
        document = json.loads(_text(path, "the aggregation"))
        groups = [(group["objectId"], group["label"]) for group in document["segGroups"]]
        others = sum(group.get("id", group["objectId"]) != group["objectId"]
                     for group in document["segGroups"])  # fmt: skip
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise DataError(f"{path} is not an aggregation of objects ({error!r})") from error
    found: dict[int, tuple[str, str | None]] = {}
    torn = set()
    for number, label in groups:
        whole = isinstance(number, int) and not isinstance(number, bool)
        if not whole or not 0 <= number < _MAX_ID or not isinstance(label, str):
            raise DataError(f"{path}: an object with objectId {number!r} and label {label!r}")
        label = label.strip()
        cls = label_map.class_of_label.get(label)
        if number in found and found[number][1] != cls:
            torn.add(number)
        found.setdefault(number, (label, cls))
    objects = [
        Labelled(number, label, cls)
        for number, (label, cls) in sorted(found.items())
        if cls is not None and number not in torn
    ]
    notes = [f"objectId {number} has labels of two classes" for number in sorted(torn)]
    if others:
        notes.append(f"{counted(others, 'object has', 'objects have')} another id than objectId")
    return objects, notes


def read_scene_list(path: str | Path) -> list[str]:
    """The scenes of scannetv2_train.txt or scannetv2_val.txt, one a line.

    Raises:
        MissingDataError: there is no such file.
        DataError: a line is not a scene's name, or there are none.
    """
    scenes = [line.strip() for line in _text(path, "a scene list").splitlines() if line.strip()]
    for scene in scenes:
        if not is_scene(scene):
            raise DataError(f"{path}: {scene!r} is not a scene; a line is like scene0000_00")
    if not scenes:
        raise DataError(f"{path} names no scenes")
    return scenes


def is_scene(name: str) -> bool:
    """Whether a name is that of a scan: scene<4 digits>_<2 digits>."""
    return re.fullmatch(r"scene\d{4}_\d{2}", name) is not None


def _text(path: str | Path, what: str) -> str:
    try:
        return read_whole(Path(path), JSON_PEAK).decode("utf-8", "replace")
    except FileNotFoundError as error:
        raise MissingDataError(f"there is no {path}, {what}") from error
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror})") from error
