"""Clouds as text: a row a point, in the dialects that programs write.

Columns are x y z and perhaps more, by blanks, commas or semicolons, with decimal points or commas;
# and // begin a comment. A first row of names says which columns are x, y and z, also as a comment.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

from qs3.datasets.clouds.shape import check_shape
from qs3.errors import DataError
from qs3.utils.memory import check_memory
from qs3.utils.plural import counted
from qs3.utils.text_table import printable

_XYZ = [b"x", b"y", b"z"]
_USUAL = frozenset(  # of columns in comments, which may be about anything
    b"x y z r g b a rgb rgba red green blue alpha i intensity reflectance id index point label "
    b"class t time timestamp ring nx ny nz normal_x normal_y normal_z curvature confidence".split()
)
_HEAD = 65_536  # bytes of comments in which names are looked for
_WORD = re.compile(rb"[^,;\s]+")
_FIRST = re.compile(rb"^[ \t]*[^\s#][^\r\n]*", re.MULTILINE)  # row that is not empty


def read_text(path: Path) -> Float[np.ndarray, "n 3"]:
    """Coordinates of all rows, float64: the columns named x, y and z, else the first three.

    Raises:
        DataError: no rows of three numbers or more; names the line. Or a table that is no cloud.
    """
    data = path.read_bytes()
    # Copies and numbers, eight bytes from two letters; and each line is an object.
    check_memory(8 * len(data) + 48 * (data.count(b"\n") + data.count(b"\r")), path)
    rows, names = _named(data.removeprefix(b"\xef\xbb\xbf").replace(b"//", b"#"))
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
    check_shape(path, table.shape)
    return table[:, _columns(path, names, table.shape[1])]


def _columns(path: Path, names: list[bytes], count: int) -> list[int]:
    """Of x, y and z among `count` columns of the file."""
    if len(names) == count:
        return [names.index(name) for name in _XYZ]
    if names and names[:3] != _XYZ:  # x would be an id, or a colour
        shown = printable(" ".join(name.decode("latin-1") for name in names[:8]))
        raise DataError(
            f"{path}: the first row names {len(names)} columns ({shown}), the others have {count}: "
            "which are x, y and z?"
        )
    return [0, 1, 2]


def _named(rows: bytes) -> tuple[bytes, list[bytes]]:
    """With an empty line in place of a first row of names; and the names, if there are any.

    A comment before all rows may have them as well, if it has no other words.
    """
    first = _FIRST.search(rows)
    if first is None:
        return rows, []
    if names := _names(first[0].split(b"#")[0]):
        return rows[: first.start()] + rows[first.end() :], names
    for line in rows[: min(first.start(), _HEAD)].splitlines():
        names = _names(line.strip().lstrip(b"#"))
        if names and _USUAL.issuperset(names):
            return rows, names
    return rows, []


def _names(line: bytes) -> list[bytes]:
    """The words, in small letters, if x, y and z are each among them once; else none."""
    words = [word.strip(b'"').lower() for word in _WORD.findall(line)]
    return words if all(words.count(name) == 1 for name in _XYZ) else []


def _decimal_commas(rows: bytes) -> bool:
    """Whether the first row is as "0,5;1,25;2,75" or "0,5 1,25 2,75": commas within numbers."""
    first = _FIRST.search(rows)
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
            has = counted(len(words), "number")
            return f"{path}, line {number}: '{shown}' has {has}, not {width or 3}"
        width = len(words)
    return f"{path}: not a text file of rows with numbers"
