"""What can be downloaded, what it is for, and under which terms: sources.yaml, read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped,unused-ignore]

from qs3.errors import ConfigError

_FILE: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("sources.yaml").read_text())


@dataclass(frozen=True)
class Part:
    """One folder of an archive, and where it goes; sources.yaml explains the keys.

    `holds` and `named` are regular expressions: for paths of files relative to the folder, of which
    `at_least` so many must match, and for the folder's own name in the archive ("": any will do).
    """

    folder: str
    holds: str
    says: str
    at_least: int
    domains: tuple[str, ...]
    named: str = ""


@dataclass(frozen=True)
class Source:
    """One archive that somebody publishes; sources.yaml explains the keys.

    `address` is that of the file, or, if it is on Google Drive with the id `drive`, of its page.
    """

    name: str
    title: str
    terms: str
    parts: tuple[Part, ...]
    address: str
    drive: str = ""
    agreement: str = ""
    size: int | None = None
    sha256: str | None = None
    size_says: str = "not known beforehand"

    @property
    def file(self) -> str:
        """Its name in the folder of downloads and on a mirror."""
        return f"{self.name}.zip" if self.drive else self.address.rpartition("/")[2]

    @property
    def domains(self) -> tuple[str, ...]:
        """All that its parts are for."""
        return tuple(domain for part in self.parts for domain in part.domains)


def _part(layout: str, domains: list[str], suffix: str = "", **more: Any) -> Part:
    values: dict[str, Any] = {
        key: value.replace("SUFFIX", suffix) if isinstance(value, str) else value
        for key, value in _FILE["layouts"][layout].items()
    }
    return Part(domains=tuple(domains), **values, **more)


def _source(name: str, parts: list[dict[str, Any]], **more: Any) -> Source:
    if "drive" in more:
        more["address"] = f"https://drive.google.com/file/d/{more['drive']}/view"
    return Source(name=name, parts=tuple(_part(**part) for part in parts), **more)


SOURCES = tuple(_source(name, **values) for name, values in _FILE["sources"].items())


@dataclass(frozen=True)
class ByHand:
    """What has to be fetched by hand: `asks` for an agreement or not; sources.yaml explains."""

    asks: str
    terms: str
    how: str


BY_HAND = {name: ByHand(**values) for name, values in _FILE["by_hand"].items()}

AGREEMENTS: dict[str, str] = _FILE["agreements"]
"""What is printed before an agreement is given, by the word of `accept_terms=`."""


def find(name: str) -> Source:
    """The source of this name; ConfigError, with a list, if there is none."""
    known = {source.name: source for source in SOURCES}
    if name in known:
        return known[name]
    raise ConfigError(f"{name!r} cannot be downloaded; known are {', '.join([*known, *BY_HAND])}")
