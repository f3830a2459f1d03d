"""From a source's name to the folder that an importer reads: fetch, check, unpack, put in place."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

from qs3.data.download import drive, layouts, transfer, unpack
from qs3.data.download.catalogue import AGREEMENTS, Part, Source
from qs3.data.download.receipts import Receipt, read_json
from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.utils.files import make_folder, sha256_file, write_json
from qs3.utils.locks import locked

log = logging.getLogger(__name__)

MARK = ".download.json"
"""In a folder that was put in place: where it came from. Importers pass over hidden files."""

_UNPACKED = 4  # times the archive's size: what text takes unpacked, for the check of free space

Bar = Callable[[str], AbstractContextManager[transfer.Report]]


@dataclass(frozen=True)
class Options:
    """How to fetch.

    Attributes:
        into: the data folder, `paths.data_dir` of a run.
        accept_terms: the agreement that the person has made, e.g. "scannet"; "" for none.
        mirror: base address of a copy of the archives; each lies there as `Source.file`.
        archive: an archive that is here already, e.g. downloaded with a browser.
        root: folder in the archive to take, where it cannot be found out.
        keep: keep the archive after unpacking; it is then not fetched again when a folder is lost.
        drive_server: of Google Drive.
        patience: see `transfer.Patience`.
    """

    into: Path = Path("data")
    accept_terms: str = ""
    mirror: str = ""
    archive: Path | None = None
    root: str = ""
    keep: bool = True
    drive_server: str = drive.SERVER
    patience: transfer.Patience = field(default_factory=transfer.Patience)

    def __post_init__(self) -> None:
        object.__setattr__(self, "into", Path(self.into))
        if self.archive is not None:
            object.__setattr__(self, "archive", Path(self.archive))
        if self.archive is not None and self.mirror:
            raise ConfigError("give archive= or mirror=, not both")


@contextlib.contextmanager
def _silent(what: str) -> Iterator[transfer.Report]:
    yield lambda done, total: None


class AgreementError(Qs3Error):
    """Terms have to be accepted first; the message says which and how."""


def provide(source: Source, options: Options | None = None, bar: Bar = _silent) -> list[Path]:
    """Bring the folders of a source to where their importers look; what is there stays.

    Nothing is fetched if all its folders are in place. An interruption at any moment leaves no
    half folder: the same call again continues.

    Returns:
        The folders, in the order of `source.parts`; those that somebody else had put there before
        are among them, untouched.

    Raises:
        AgreementError: `source.agreement` was not accepted.
        DataError: what came is not the published file, or is not to be trusted, or a folder is in
            the way.
        Qs3Error: network, disk.
    """
    options = options or Options()
    if source.agreement and options.accept_terms != source.agreement:
        text = AGREEMENTS[source.agreement]
        raise AgreementError(text.format(name=source.name, title=source.title))
    if options.root and len(source.parts) > 1:
        raise ConfigError(f"{source.name} has several parts, so root= cannot be given")
    published = options.into / "published"
    places = [published / part.folder for part in source.parts]
    with locked(_downloads(options) / f".{source.name}.lock"):
        missing = [
            (part, place)
            for part, place in zip(source.parts, places, strict=True)
            if not _is_in_place(place, source)
        ]
        if not missing:
            return places
        archive, receipt, ours = _archive(source, options, bar)
        _place(source, missing, archive, receipt, options, bar)
        if ours and not options.keep:
            archive.unlink()
    return places


def _is_in_place(place: Path, source: Source) -> bool:
    """Whether the folder is there; says so if it did not come from this source."""
    if not os.path.lexists(place) or (place.is_dir() and not any(place.iterdir())):
        return False
    origin = read_json(place / MARK).get("source")
    if origin != source.name:
        log.warning(
            "%s is there already (%s) and is left alone; move it away to have it from %s",
            place,
            f"from {origin}" if origin else "not put there by this command",
            source.name,
        )
    return True


def _downloads(options: Options) -> Path:
    return make_folder(options.into / "downloads")


def _archive(source: Source, options: Options, bar: Bar) -> tuple[Path, Receipt, bool]:
    """The archive, its receipt, and whether it lies in our folder of downloads."""
    if options.archive is not None:
        path = options.archive
        if not path.is_file():
            raise ConfigError(f"archive={path}: there is no such file")
        return path, Receipt(str(path), path.stat().st_size, sha256_file(path)), False
    path = _downloads(options) / source.file
    by_drive = bool(source.drive_id) and not options.mirror
    wanted = transfer.Wanted(
        source.url(options.mirror, options.drive_server),
        path,
        size=source.size,
        page=drive.page_of(source.drive_id) if by_drive else None,
    )
    with bar(f"fetching {source.file}") as report:
        receipt = transfer.fetch(wanted, options.patience, report)
    log.info("%s: %d bytes, SHA-256 %s", path, receipt.size, receipt.sha256)
    return path, receipt, True


def _place(
    source: Source,
    missing: list[tuple[Part, Path]],
    archive: Path,
    receipt: Receipt,
    options: Options,
    bar: Bar,
) -> None:
    """Unpack into a folder beside the final ones, find the parts, and rename them into place."""
    published = make_folder(options.into / "published")
    building = published / f".{source.name}.unpacking"
    unpack.delete(building)  # what a killed run left
    free, needed = shutil.disk_usage(published).free, _UNPACKED * receipt.size
    if needed > free:
        raise Qs3Error(
            f"{published} has {free / 1e9:.1f} GB free, unpacking {archive} takes about "
            f"{needed / 1e9:.1f} GB: free some space or choose another folder with into="
        )
    try:
        with bar(f"unpacking {archive.name}") as report:
            unpack.unpack(archive, building, report=report)
        files = layouts.files_below(building)
        for part, place, root in _found(missing, files, archive, options.root):
            folder = building / root if root else building
            write_json(folder / MARK, {"source": source.name, "root": root, **receipt._asdict()})
            make_folder(place.parent)
            if place.is_dir():
                place.rmdir()  # empty, see `_is_in_place`
            os.rename(folder, place)
            log.info("%s: %s", place, part.layout.says)
    finally:
        unpack.delete(building)


def _found(
    missing: list[tuple[Part, Path]], files: list[str], archive: Path, root: str
) -> list[tuple[Part, Path, str]]:
    """Each part with its folder in the archive; all are found before the first is moved."""
    found = []
    for part, place in missing:
        try:
            inside = layouts.chosen(root, files) if root else part.layout.find(files)
        except Qs3Error as error:
            raise DataError(
                f"{archive}: {error}. It holds\n{layouts.outline(files)}\nThe archive is kept; "
                "take a folder of it with root=FOLDER, or unpack it yourself (and archives in it, "
                f"if any) so that {place} holds {part.layout.says}"
            ) from error
        found.append((part, place, inside))
    return found
