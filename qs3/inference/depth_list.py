"""Which depth images are meant, and what in them: one picture, two folders, or a list.

    depth=frame.png mask=mask.png                  each number of the mask is an object
    depth=frame.png box=210,95,480,430             the object in a box
    depth=frames mask=masks                        two folders; masks have the names of the frames
    depth=objects.csv                              a row an object or a picture, columns:

        depth         file, relative to the list
        mask, object  file, and the number of its one object that is meant (none: all)
        box           left,top,right,bottom; a mask or a box
        intrinsics, up, depth_scale, label         those of the command line where empty

Columns are divided by commas, or by semicolons or tabs if the first row has no comma. A list may
also be .json or .yaml: a list of such mappings.
"""

from __future__ import annotations

import csv
import io
import logging
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.utils.plural import counted
from qs3.utils.yamls import load_yaml

log = logging.getLogger(__name__)

LISTS = (".csv", ".json", ".yaml", ".yml")
IMAGES = (".png", ".npy")

_COLUMNS = ("depth", "mask", "object", "box", "intrinsics", "up", "depth_scale", "label")
_MOST_BYTES = 64 << 20
_UP_WORDS = {"-y": (0.0, -1.0, 0.0)}


@dataclass(frozen=True)
class Shown:
    """What is meant of one depth image.

    Attributes:
        name: of the picture in the table.
        depth: its file.
        mask, box: of the object or objects; one of both.
        only: number of the one object of the mask; None: all.
        intrinsics: "fx,fy,cx,cy", or a file.
        folder: that the file of intrinsics is relative to.
        up: in camera coordinates; None: not known.
        scale_m: metres a unit; None: see `qs3.datasets.depth_images`.
        label: what it is; "" if nobody said.
        wrong: the row cannot be understood, and why.
    """

    name: str
    depth: Path = Path()
    mask: Path | None = None
    box: tuple[float, ...] | None = None
    only: int | None = None
    intrinsics: str = ""
    folder: Path = Path()
    up: tuple[float, ...] | None = None
    scale_m: float | None = None
    label: str = ""
    wrong: str = ""


def find_shown(depth: str, mask: str, common: Shown) -> tuple[list[Shown], Counter[str]]:
    """The pictures, and how many files of other kinds were passed over.

    Args:
        depth: a file, a folder or a list.
        mask: a file, or a folder like that of `depth`; "" for none.
        common: what holds where a list says nothing; its name and files do not count.

    Raises:
        MissingDataError: a file is not there.
        ConfigError, DataError: words that do not go together, or a list that is none.
    """
    place = Path(depth).expanduser()
    if place.suffix.lower() in LISTS and place.is_file():
        if mask or common.box:
            raise ConfigError(f"depth={depth} is a list; it says itself which mask or box is meant")
        return _of_list(place, common), Counter()
    if place.is_dir():
        return _of_folder(place, mask, common)
    if not place.is_file():
        raise MissingDataError(f"depth={depth} is not there")
    _one_of(mask, common.box)
    if mask and not Path(mask).expanduser().is_file():
        raise MissingDataError(f"mask={mask} is not there, or no file")
    shown = replace(common, name=place.name, depth=place)
    return [replace(shown, mask=Path(mask).expanduser()) if mask else shown], Counter()


def numbers(words: Any, count: int, what: str) -> tuple[float, ...]:
    """`count` numbers of a text with commas or blanks between them, or of a list.

    Raises:
        ConfigError: other words; says which.
    """
    parts = words if isinstance(words, list | tuple) else str(words).replace(",", " ").split()
    try:
        found = tuple(float(part) for part in parts)
    except (TypeError, ValueError, OverflowError):
        found = ()
    if len(found) != count:
        raise ConfigError(f"{what}={words}: expected {count} numbers with commas between them")
    return found


def direction(words: Any) -> tuple[float, ...] | None:
    """What up= says in camera coordinates: x,y,z, or "-y" for a level camera; "" is not known."""
    if words in ("", None):
        return None
    if isinstance(words, str) and words in _UP_WORDS:
        return _UP_WORDS[words]
    return numbers(words, 3, "up")


def check_scale(metres: float) -> None:
    """Raise ConfigError if that cannot be the metres of a unit of depth."""
    if not 0 < metres <= 1:
        raise ConfigError(f"depth_scale={metres:g}: metres a unit, in (0, 1]")


def _one_of(mask: str, box: Sequence[float] | None) -> None:
    if bool(mask) == (box is not None):
        raise ConfigError(
            "a depth image takes mask=FILE (each number in it is an object) or "
            "box=left,top,right,bottom, and not both"
        )


def _of_folder(place: Path, mask: str, common: Shown) -> tuple[list[Shown], Counter[str]]:
    masks = Path(mask).expanduser()
    if not mask or not masks.is_dir() or common.box:
        raise ConfigError(
            f"depth={place} is a folder; give mask=FOLDER with masks of the same names, or a list: "
            "depth=objects.csv with the columns depth and box or mask"
        )
    by_stem = {path.stem: path for path in sorted(masks.iterdir()) if path.suffix.lower() in IMAGES}
    found: list[Shown] = []
    others: Counter[str] = Counter()
    for path in sorted(place.iterdir()):
        if path.name.startswith("."):
            continue
        if not path.is_file() or path.suffix.lower() not in IMAGES:
            others[path.suffix.lower()] += 1
            continue
        of = by_stem.get(path.stem)
        wrong = "" if of else f"no mask of its name in {mask}"
        found.append(replace(common, name=path.name, depth=path, mask=of, wrong=wrong))
    if not found:
        raise MissingDataError(f"depth={place} holds no .png and no .npy")
    if alone := sorted({*by_stem} - {one.depth.stem for one in found}):
        first = by_stem[alone[0]].name
        few = counted(len(alone), "mask has", "masks have")
        log.warning("mask=%s: %s no depth image of the name, such as %s", mask, few, first)
    return found, others


def _of_list(path: Path, common: Shown) -> list[Shown]:
    try:
        size = path.stat().st_size
        if size > _MOST_BYTES:
            raise DataError(f"{path}: {size} bytes; a list has at most {_MOST_BYTES}")
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read ({error})") from error
    rows = _table(text, path) if path.suffix.lower() == ".csv" else _mappings(text, path)
    rows = [_by_column(row) for row in rows]
    if not rows:
        raise DataError(f"{path} lists no pictures")
    unknown = sorted({str(key) for row in rows for key in row} - {*_COLUMNS})
    if unknown:
        raise DataError(
            f"{path}: unknown columns {', '.join(unknown)}; known are {', '.join(_COLUMNS)}"
        )
    return [_row(row, path, number, common) for number, row in enumerate(rows, start=1)]


def _table(text: str, path: Path) -> list[Mapping[str, Any]]:
    first = next(iter(text.splitlines()), "")  # no column's name has any of these in it
    mark = next((mark for mark in ";\t" if mark in first and "," not in first), ",")
    lines = io.StringIO(text, newline="")
    reader = csv.DictReader(lines, restkey="more", delimiter=mark, skipinitialspace=True)
    try:
        rows = list(reader)
    except csv.Error as error:
        raise DataError(f"{path}: {error}") from error
    if wide := next((i for i, row in enumerate(rows, start=1) if "more" in row), 0):
        raise DataError(
            f"{path}, row {wide}: more cells than columns; a box stands between quotes: "
            '"210,95,480,430"'
        )
    return [{key: value or "" for key, value in row.items()} for row in rows]


def _by_column(row: Mapping[str, Any]) -> dict[str, Any]:
    """With columns as this module names them: spreadsheets write Depth, and a blank behind."""
    named: dict[str, Any] = {}
    for key, value in row.items():
        plain = str(key).strip().lower()
        taken = plain in row or plain in named
        named[key if taken or plain not in _COLUMNS else plain] = value
    return named


def _mappings(text: str, path: Path) -> list[Mapping[str, Any]]:
    found = load_yaml(text, path)
    if not isinstance(found, list) or not all(isinstance(row, Mapping) for row in found):
        raise DataError(f"{path}: expected a list of mappings with {', '.join(_COLUMNS)}")
    return found


def _row(row: Mapping[str, Any], path: Path, number: int, common: Shown) -> Shown:
    """What a row says; one that cannot be understood is `wrong`, and costs only itself."""
    given = {key: value for key, value in row.items() if value not in ("", None)}
    name = given.get("depth")
    name = name if isinstance(name, str) else f"{path.name}, row {number}"
    folder = path.parent
    try:
        if not all(_plain(value) for value in given.values()):
            raise ConfigError("a value is neither a word, a number nor a few numbers")
        if "depth" not in given:
            raise ConfigError("no depth image")
        box = numbers(given["box"], 4, "box") if "box" in given else None
        _one_of(str(given.get("mask", "")), box)
        only = _object(given["object"]) if "object" in given else None
        if only is not None and box is not None:
            raise ConfigError(f"object={only} is the number of one of a mask; here is a box")
        scale = _scale(given["depth_scale"]) if "depth_scale" in given else None
        shown = replace(
            common,
            name=name,
            depth=folder / os.path.expanduser(name),
            mask=folder / os.path.expanduser(str(given["mask"])) if "mask" in given else None,
            box=box,
            only=only,
            up=direction(given["up"]) if "up" in given else common.up,
            scale_m=common.scale_m if scale is None else scale,
            label=str(given.get("label", "")),
        )
        if "intrinsics" in given:
            words = given["intrinsics"]
            words = ",".join(map(str, words)) if isinstance(words, list) else str(words)
            shown = replace(shown, intrinsics=words, folder=folder)
    except (ConfigError, TypeError, ValueError, OverflowError) as error:
        # Its camera and label may be known all the same: neither is what is missing.
        camera, label = str(given.get("intrinsics", common.intrinsics)), given.get("label", "")
        label = str(label) if _plain(label) and not isinstance(label, list) else ""
        wrong = f"{path.name}, row {number}: {error}"
        return Shown(name, intrinsics=camera, folder=folder, label=label, wrong=wrong)
    if not shown.intrinsics:
        return replace(shown, wrong=f"{path.name}, row {number}: no intrinsics")
    return shown


def _object(words: Any) -> int:
    """A whole number, also as 3.0: so spreadsheets and pandas write columns with empty cells."""
    try:
        found = float("nan") if isinstance(words, bool) else float(words)
    except (TypeError, ValueError, OverflowError):
        found = float("nan")
    if not found.is_integer():
        raise ConfigError(f"object={words}: expected the whole number of an object of the mask")
    return int(words) if isinstance(words, int) else int(found)


def _scale(words: Any) -> float:
    try:
        found = float(words)
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(
            f"depth_scale={words}: expected a number, the metres of a unit, such as 0.001"
        ) from error
    check_scale(found)
    return found


def _plain(value: Any) -> bool:
    """A word, a number, or at most 16 of them: aliases in YAML can make lists without end."""
    if isinstance(value, list):
        return len(value) <= 16 and all(isinstance(one, int | float | str) for one in value)
    return isinstance(value, int | float | str)
