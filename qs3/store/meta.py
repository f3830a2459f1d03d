"""meta.yaml: the description of a finished dataset; its last line is a checksum of the others."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped,unused-ignore]

from qs3.errors import DataError, MissingDataError
from qs3.store.array_files import shards_fit
from qs3.store.manifest import AGAIN
from qs3.utils.files import write_text
from qs3.utils.memory import read_whole

FORMAT_VERSION = 1
META = "meta.yaml"
_CHECKSUM = "# sha256 of the lines above: "
# A run opens its datasets some ten times, and libyaml is ten times as fast.
_PEAK = 200  # of memory to its size: each value is an object before it is itself
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def is_finished(folder: str | Path) -> bool:
    """Whether `folder` holds a dataset whose writing came to its end."""
    return (Path(folder) / META).is_file()


def write_meta(folder: Path, facts: Mapping[str, Any], others: Mapping[str, Any]) -> None:
    """Write plain values with their checksum: from here on the dataset is finished.

    Raises:
        DataError: `others`, which are the caller's, use a key of the format or of `facts`.
    """
    document = {"format": "qs3 point clouds", "format_version": FORMAT_VERSION, **facts}
    if clash := sorted(set(document) & set(others)):
        raise DataError(f"meta of dataset {facts.get('name')!r} may not use the keys {clash}")
    text = yaml.safe_dump({**document, **others}, sort_keys=False, allow_unicode=True, width=100)
    write_text(folder / META, text + _CHECKSUM + sha256_of(text) + "\n")


def meta_of_finished(folder: Path) -> dict[str, Any]:
    """As `read_meta`, and says what lies there instead where there is none.

    Raises:
        MissingDataError: there is no such folder, its dataset was not finished, or it is
            something else.
        DataError: as `read_meta`.
    """
    if not is_finished(folder):
        raise MissingDataError(f"there is no finished dataset in {folder} (no {META})")
    return read_meta(folder)


def read_meta(folder: str | Path) -> dict[str, Any]:
    """The contents of a finished dataset's meta.yaml, checked against its last line.

    Raises:
        DataError: damaged, edited, or of another version of the format.
    """
    path = Path(folder) / META
    try:
        text = read_whole(path, _PEAK).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read ({error}); {AGAIN}") from error
    body, mark, checksum = text.rpartition(_CHECKSUM)
    if not mark or checksum != sha256_of(body) + "\n":
        raise DataError(f"{path} is damaged or was edited (its checksum is wrong); {AGAIN}")
    try:
        meta = yaml.load(body, _LOADER)
        version = meta.get("format_version")
    except (yaml.YAMLError, AttributeError, ValueError, RecursionError) as error:
        raise DataError(f"{path} was written by something else ({error}); {AGAIN}") from error
    if version != FORMAT_VERSION:
        raise DataError(
            f"{path} has format version {version}, this qs3 reads "
            f"{FORMAT_VERSION}; use the qs3 that wrote it ({meta.get('created_by')}) or {AGAIN}"
        )
    if odd := _odd(meta):
        raise DataError(f"{path} has no {odd} as `write_pointset` writes it; {AGAIN}")
    return meta


def _words(value: Any) -> bool:
    """A list of different words."""
    words = isinstance(value, list) and all(isinstance(one, str) for one in value)
    return words and len({*value}) == len(value)


_META_FITS: dict[str, Callable[[Any], bool]] = {
    "name": lambda value: isinstance(value, str),
    "classes": lambda value: _words(value) and len(value) > 0,
    "clouds": lambda value: type(value) is int and value > 0,
    "points": lambda value: type(value) is int and value > 0,
    "sha256": lambda value: (
        isinstance(value, dict) and "manifest" in value and _words(sorted(map(str, value)))
    ),
    "tables": lambda value: (
        value is None or (isinstance(value, dict) and all(map(_words, value.values())))
    ),
}


def _odd(meta: Mapping[str, Any]) -> str:
    """The first key whose value is not as `write_pointset` writes it; "" if there is none."""
    for key, fits in _META_FITS.items():
        if not fits(meta.get(key)):
            return key
    arrays = {*meta["sha256"]} - {"manifest"}
    if not {*(meta.get("tables") or {})} <= arrays:
        return "tables"
    return "" if shards_fit(meta.get("shards"), meta["clouds"], arrays) else "shards"


def sha256_of(text: str) -> str:
    """64 hex digits of its UTF-8 bytes."""
    return hashlib.sha256(text.encode()).hexdigest()
