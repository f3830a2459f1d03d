"""From a source's name to the folder that an importer reads: fetch, unpack, put in place."""

from __future__ import annotations

import json
import logging
import os
import shlex
import shutil
from pathlib import Path

from qs3.datasets.download.archives import find_folder, outline, unpack
from qs3.datasets.download.catalogue import AGREEMENTS, Part, Source
from qs3.datasets.download.fetching import fetch
from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.utils.files import make_folder, sha256_file, write_json
from qs3.utils.locks import locked
from qs3.utils.memory import JSON_PEAK, read_whole

log = logging.getLogger(__name__)

MARK = ".download.json"
"""In a folder that was put in place: where it came from. Importers pass over hidden files."""


class AgreementError(Qs3Error):
    """Terms have to be accepted first; the message says which and how."""


def provide(
    source: Source,
    into: Path = Path("data"),
    *,
    accept_terms: str = "",
    mirror: str = "",
    archive: Path | None = None,
    root: str = "",
    keep: bool = True,
) -> list[Path]:
    """Bring the folders of a source to where their importers look; what is there stays.

    Nothing is fetched if all its folders are in place. An interruption at any moment leaves no
    half folder: the same call again continues.

    Args:
        source: of the catalogue.
        into: the data folder, `paths.data_dir` of a run.
        accept_terms: the agreement that the person has made, e.g. "scannet".
        mirror: base address of a copy of the archives; each lies there as `Source.file`.
        archive: an archive that is here already, e.g. downloaded with a browser.
        root: folder in the archive to take, where it cannot be found out.
        keep: keep the archive after unpacking; it is then not fetched again when a folder is lost.

    Returns:
        The folders, in the order of `source.parts`, also those that somebody else had put there.

    Raises:
        AgreementError: `source.agreement` was not accepted.
        DataError: the archive is damaged, not to be trusted, or holds something else.
        DownloadError, Qs3Error: network, disk.
    """
    if source.agreement and accept_terms != source.agreement:
        text = AGREEMENTS[source.agreement]
        where = "" if into == Path("data") else f" {shlex.quote(f'into={into}')}"
        raise AgreementError(text.format(name=source.name, where=where, title=source.title))
    if root and len(source.parts) > 1:
        raise ConfigError(f"{source.name} has several parts, so root= cannot be given")
    if archive is not None and mirror:
        raise ConfigError("give archive= or mirror=, not both")
    if archive is not None and not archive.is_file():
        raise ConfigError(f"archive={archive}: there is no such file")
    downloads = make_folder(into / "downloads")
    published = into / "published"
    places = {part: published / part.folder for part in source.parts}
    with locked(downloads / f".{source.name}.lock"):
        missing = {part: at for part, at in places.items() if not _is_in_place(at, source)}
        if missing:
            path = archive or fetch(
                f"{mirror.rstrip('/')}/{source.file}" if mirror else source.address,
                downloads / source.file,
                sha256=source.sha256,
                size=source.size,
                drive="" if mirror else source.drive,
            )
            _place(source, missing, path, root, published)
            if archive is None and not keep:
                path.unlink()
    return list(places.values())


def _is_in_place(place: Path, source: Source) -> bool:
    """Whether the folder is there; says so if it did not come from this source."""
    if not os.path.lexists(place) or (place.is_dir() and not any(place.iterdir())):
        return False
    try:
        origin = json.loads(read_whole(place / MARK, JSON_PEAK))["source"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError, DataError):
        origin = None
    if origin != source.name:
        log.warning(
            "%s is there already (%s) and is left alone; move it away to have it from %s",
            place,
            f"from {origin}" if origin else "not put there by this command",
            source.name,
        )
    return True


def _place(
    source: Source, missing: dict[Part, Path], archive: Path, root: str, published: Path
) -> None:
    """Unpack into a folder next to the final ones, find the parts, and rename them into place."""
    building = published / f".{source.name}.unpacking"
    shutil.rmtree(building, ignore_errors=True)  # what a killed run left
    sha256 = sha256_file(archive)
    log.info("%s: SHA-256 %s", archive, sha256)
    try:
        files = unpack(archive, building)
        found = {part: _find(part, files, archive, root, place) for part, place in missing.items()}
        for part, place in missing.items():
            folder = building / found[part]
            mark = {"source": source.name, "root": found[part], "sha256": sha256}
            write_json(folder / MARK, {**mark, "size": archive.stat().st_size})
            make_folder(place.parent)
            if place.is_dir():
                place.rmdir()  # empty, see `_is_in_place`
            os.rename(folder, place)
    finally:
        shutil.rmtree(building, ignore_errors=True)


def _find(part: Part, files: list[str], archive: Path, root: str, place: Path) -> str:
    """The part's folder in the archive."""
    root = root.strip("/")
    try:
        if not root:
            return find_folder(files, part.holds, part.named, part.at_least)
        if not any(file.startswith(f"{root}/") for file in files):
            raise DataError(f"root={root}: no folder with files has this name")
        return root
    except DataError as error:
        raise DataError(
            f"{archive}: {error}. Wanted is {part.says}, found\n{outline(files)}\n"
            "The archive is kept; take a folder of it with root=FOLDER, or unpack it yourself so "
            f"that {place} holds what is wanted"
        ) from error
