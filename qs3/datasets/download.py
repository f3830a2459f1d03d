"""Published datasets, fetched when a person asks for one, and put where their importers look.

Training never downloads. What there is, what it is for and under which terms stands in
sources.yaml, which explains its keys.
"""

import os
import re
import shutil
import tarfile
import zipfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped,unused-ignore]

from qs3.errors import DataError, Qs3Error
from qs3.utils.files import locked, make_folder, reading
from qs3.utils.settings import settings

_FILE: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("sources.yaml").read_text())

BY_HAND: dict[str, dict[str, str]] = _FILE["by_hand"]
"""What has to be fetched by hand: whether it `asks` for an agreement, its `terms`, and `how`."""


class AgreementError(Qs3Error):
    """Terms have to be accepted first; the message says which and how."""


@settings
class Part:
    """One folder of an archive, and where it goes; sources.yaml explains the keys."""

    folder: str
    layout: str
    domains: list[str]
    suffix: str = ""
    named: str = ""

    def of_layout(self, key: str) -> Any:
        """What the part's layout has under `key`: "holds", "says" or "at_least"."""
        value = _FILE["layouts"][self.layout][key]
        return value.replace("SUFFIX", self.suffix) if isinstance(value, str) else value


@settings
class Source:
    """One archive that somebody publishes; sources.yaml explains the keys."""

    name: str
    title: str
    terms: str
    parts: list[Part]
    address: str = ""
    drive: str = ""
    agreement: str = ""
    size_says: str = "not known beforehand"

    @property
    def page(self) -> str:
        """Where a browser finds it."""
        return self.address or f"https://drive.google.com/file/d/{self.drive}/view"

    @property
    def file(self) -> str:
        """Its name in the folder of downloads."""
        return f"{self.name}.zip" if self.drive else self.address.rpartition("/")[2]

    @property
    def domains(self) -> list[str]:
        """All that its parts are for."""
        return [domain for part in self.parts for domain in part.domains]


SOURCES = {name: Source(name=name, **values) for name, values in _FILE["sources"].items()}


def provide(
    source: Source,
    into: Path = Path("data"),
    *,
    accept_terms: str = "",
    archive: Path | None = None,
) -> list[Path]:
    """Bring the folders of a source to where their importers look; what is there stays.

    Nothing is fetched if all its folders are in place. An interruption at any moment leaves no
    half folder: the same call again starts over. For the arguments see `qs3.commands.download`.
    Returns the folders in the order of `source.parts`.
    """
    if source.agreement and accept_terms != source.agreement:
        text, where = _FILE["agreements"][source.agreement], f" into={into}"
        raise AgreementError(text.format(name=source.name, where=where, title=source.title))
    downloads, published = make_folder(into / "downloads"), into / "published"
    places = [published / part.folder for part in source.parts]
    with locked(downloads / f".{source.name}.lock"):
        pairs = zip(source.parts, places, strict=True)
        missing = [(part, at) for part, at in pairs if not at.exists() or not any(at.iterdir())]
        if missing:
            path = archive or fetch(source, downloads / source.file)
            building = published / f".{source.name}.unpacking"
            shutil.rmtree(building, ignore_errors=True)  # what a killed run left
            try:
                _place(missing, path, building)
            finally:
                shutil.rmtree(building, ignore_errors=True)
    return places


def _place(missing: list[tuple[Part, Path]], archive: Path, building: Path) -> None:
    """Unpack into a folder next to the final ones, find the parts, and rename them into place."""
    files = unpack(archive, building)
    folders = [find_folder(archive, files, part) for part, _ in missing]
    for (_, place), found in zip(missing, folders, strict=True):
        make_folder(place.parent)
        if place.is_dir():
            place.rmdir()  # empty
        os.rename(building / found, place)


def fetch(source: Source, path: Path) -> Path:
    """Bring a source's archive to `path`; one that is there already is left alone."""
    import pooch
    import requests

    def from_drive(_url: str, output_file: str, _pooch: Any) -> None:
        import gdown

        try:
            gdown.download(id=source.drive, output=output_file, quiet=not os.isatty(2))
        except gdown.exceptions.DownloadError as error:
            raise ValueError(f"Google Drive does not give it: {error}") from error

    downloader = from_drive if source.drive else None
    try:
        pooch.retrieve(source.page, None, path.name, path.parent, downloader=downloader)
    except (requests.RequestException, ValueError) as error:
        raise Qs3Error(f"{source.page}: {error}; or fetch it by hand for archive=PATH") from error
    return path


def unpack(archive: Path, into: Path) -> list[str]:
    """Unpack a .zip or .tar, packed or not, into a new folder, and list its files.

    Nothing is written outside of the folder: zipfile drops what leads out of names, tarfile's
    filter refuses it. Mac OS's companions (`__MACOSX`, `._name`) are not listed.
    """
    with reading(archive):
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as packed:
                packed.extractall(into)
        else:
            with tarfile.open(archive) as packed_tar:
                packed_tar.extractall(into, filter="data")
    files = (path.relative_to(into) for path in sorted(into.rglob("*")) if path.is_file())
    return [str(p) for p in files if "__MACOSX" not in p.parts and not p.name.startswith("._")]


def find_folder(archive: Path, files: Iterable[str], part: Part) -> str:
    """The folder of an unpacked archive that an importer reads, however it is nested.

    `files` and the result are relative to the archive's top, with slashes; "" is the top itself.
    """
    name = rf"(?:.*/)?(?i:{part.named})/" if part.named else r"(?:.*/)?"
    pattern = re.compile(rf"(?P<root>{name}){part.of_layout('holds')}")
    roots = Counter(found["root"] for file in files if (found := pattern.fullmatch(file)))
    large = sorted(root for root, count in roots.items() if count >= part.of_layout("at_least"))
    if len(large) != 1:
        raise DataError(
            f"{archive}: folders of {part.of_layout('says')}: {', '.join(large) or 'none'}; unpack "
            "the wanted one by hand"
        )
    return large[0].rstrip("/")
