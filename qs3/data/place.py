"""What lies where a dataset was expected, and what to type instead."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from shlex import quote

from qs3.clouds.files import SUFFIXES

_ARCHIVE_KEY = "xyz_tenth_mm.npy"  # see `importers.object_archive`
_BEGUN = ("recipe.json", "manifest.csv")  # of a generation; of a store, which meta.yaml completes
_BESIDE = ".{}.parts", ".{}.importing"  # of an import (`importers.base`)
_SHOWN = 5  # names of datasets
_LOOKED_AT = 10_000  # names in a folder and below, for clouds
_CONTINUE = "run the same command again and it continues"


def instead_of_dataset(place: Path, meta: str) -> str:
    """Says what `place` is, which is no finished dataset's folder; `meta` is the file it lacks."""
    if place.is_file():
        return _of_file(place)
    if not place.is_dir():
        if any(place.with_name(name.format(place.name)).exists() for name in _BESIDE):
            return f"{place} is not there yet: its import was not finished; {_CONTINUE}"
        return f"there is no dataset folder {place}"
    if any((place / name).is_file() for name in _BEGUN):
        return f"{place} has no {meta}: the generation or import was not finished; {_CONTINUE}"
    if stores := sorted(path.parent for path in place.glob(f"*/{meta}")):
        names = ", ".join(map(str, stores[:_SHOWN])) + ", ..." * (len(stores) > _SHOWN)
        return f"{place} holds datasets and is none itself; name one of them: {names}"
    if _holds_clouds(place):
        return (
            f"{place} is a folder of clouds, not a dataset (it has no {meta}); they are the domain "
            f"own: qs3 inspect domain=own published.folder={quote(str(place))}"
        )
    return f"{place} is no dataset: it has no {meta}, and no clouds of {' '.join(SUFFIXES)}"


def _of_file(path: Path) -> str:
    if is_archive(path):
        return (
            f"{path} is an archive of objects, not a dataset's folder; it is the domain objects: "
            f"qs3 inspect domain=objects published.file={quote(str(path.absolute()))}"
        )
    text = f"{path} is a file, not a dataset's folder"
    if path.suffix.lower() in SUFFIXES:
        text += (
            "; a folder of clouds is the domain own: qs3 inspect domain=own published.folder=FOLDER"
        )
    return text


def is_archive(path: Path) -> bool:
    """Whether a file is an .npz of objects cut from depth images."""
    if path.suffix.lower() != ".npz":
        return False
    try:
        with zipfile.ZipFile(path) as file:
            return _ARCHIVE_KEY in file.namelist()
    except Exception:  # what zipfile makes of damaged bytes cannot be listed
        return False  # said when it is read as clouds


def _holds_clouds(folder: Path) -> bool:
    """Whether one of the first names below a folder is that of a cloud's file."""
    return any(
        path.suffix.lower() in SUFFIXES and path.is_file()
        for path, _ in zip(_below(folder), range(_LOOKED_AT), strict=False)
    )


def _below(folder: Path) -> Iterator[Path]:
    """As folders are read into the domain own: no hidden names, no links to folders."""
    try:
        paths = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError:
        return
    for path in paths:
        yield path
        if path.is_dir() and not path.is_symlink():
            yield from _below(path)
