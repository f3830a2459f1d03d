"""`qs3 download`: fetch a published dataset and put it where its domain looks for it."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qs3.datasets.download.catalogue import BY_HAND, SOURCES, find
from qs3.errors import ConfigError
from qs3.utils.cli import FLAG, Command, Option, text

MIRROR = "QS3_DOWNLOAD_MIRROR"


def _download(words: Sequence[str], **given: Any) -> int:
    if not words:
        print(listing())
        return 0
    if len(words) > 1:
        raise ConfigError(f"one dataset at a time, got {' and '.join(words)}")
    (name,) = words
    if name in BY_HAND:
        print(BY_HAND[name].how)
        return 1
    from qs3.datasets.download.provide import AgreementError, provide

    source = find(name)
    given["into"] = Path(given["into"])
    if given["archive"]:
        given["archive"] = Path(given["archive"])
    else:
        given["mirror"] = given["mirror"] or os.environ.get(MIRROR, "")
    try:
        places = provide(source, **given)
    except AgreementError as error:
        print(error)
        return 1
    for part, place in zip(source.parts, places, strict=True):
        used = " and ".join(f"domain={domain}" for domain in part.domains)
        print(f"{place} is there{f', for {used}' if used else ''}")
    return 0


def listing() -> str:
    """All there is to fetch, for people."""
    lines = ["qs3 download NAME   (--help for more)", ""]
    for source in SOURCES:
        need = f" (accept_terms={source.agreement})" if source.agreement else ""
        lines.append(source.name)
        for paragraph in (
            source.title,
            f"for {', '.join(f'domain={d}' for d in source.domains) or 'qs3-generate meshes='}",
            f"size: {source.size_says}; file: {source.file}",
            f"from: {source.address}",
            f"terms: {source.terms}{need}",
        ):
            lines += textwrap.wrap(paragraph, 96, initial_indent="    ", subsequent_indent="      ")
    for asks in dict.fromkeys(one.asks for one in BY_HAND.values()):
        lines += ["", f"By hand, {asks} (NAME prints how)"]
        for name, one in BY_HAND.items():
            if one.asks == asks:
                words = f"{name}: {one.terms}"
                lines += textwrap.wrap(words, 96, initial_indent="    ", subsequent_indent="      ")
    return "\n".join(lines)


DOWNLOAD = Command(
    "qs3 download",
    "published datasets, put where their domain looks for them",
    _download,
    (
        Option("into", text("FOLDER"), "the data folder, paths.data_dir of a run", "data"),
        Option("accept_terms", text("WORD"), "the agreement that you have made, e.g. scannet", ""),
        Option(
            "mirror", text("ADDRESS"), f"address of a copy of the archives (default ${MIRROR})", ""
        ),
        Option("archive", text("FILE"), "unpack this, e.g. what your browser downloaded"),
        Option(
            "root", text("FOLDER"), "folder in the archive to take, if it cannot be found out", ""
        ),
        Option("keep", FLAG, "false deletes the archive when it is unpacked", True),
    ),
    (
        "qs3 download                              what there is",
        "qs3 download modelnet40_off",
        "qs3 download scannet10 accept_terms=scannet into=data",
    ),
    about="""
Archives come to downloads/ in the data folder, what is in them to published/. On a mirror each lies
under the name that the list shows.

An interrupted download continues where it ended: run the same command again. What is in place is
left alone. No hashes of these files were published; zip and gzip have checksums of their own, of
ModelNet10.zip the size is known, and .download.json in the folder notes the SHA-256 of the archive.
""",
    words="[NAME]",
)
