"""`qs3 download`: fetch a published dataset and put it where its domain looks for it."""

from __future__ import annotations

import os
import textwrap
from pathlib import Path
from typing import Annotated

MIRROR = "QS3_DOWNLOAD_MIRROR"


def download(
    name: Annotated[str, "of the dataset; without it, what there is is listed"] = "",
    *,
    into: Annotated[Path, "the data folder, paths.data_dir of a run"] = Path("data"),
    accept_terms: Annotated[str, "the agreement that you have made, e.g. scannet"] = "",
    mirror: Annotated[str, f"address of a copy of the archives; else that of ${MIRROR}"] = "",
    archive: Annotated[Path | None, "unpack this, e.g. what your browser downloaded"] = None,
    root: Annotated[str, "folder in the archive to take, if it cannot be found out"] = "",
) -> int:
    """Published datasets, put where their domain looks for them.

    Archives come to downloads/ in the data folder, what is in them to published/. On a mirror each
    lies under the name that the list shows. What is in place is left alone. No hashes of these
    files were published; of ModelNet10.zip the size is known, and .download.json in the folder
    notes the SHA-256 of the archive.

    Example:
        qs3 download                              what there is
        qs3 download modelnet40_off
        qs3 download scannet10 accept_terms=scannet into=data
    """
    from qs3.datasets.download import BY_HAND, SOURCES, AgreementError, provide
    from qs3.errors import ConfigError
    from qs3.utils.commands import meant

    if not name:
        print(listing())
        return 0
    if name in BY_HAND:
        print(BY_HAND[name]["how"])
        return 1
    if name not in SOURCES:
        raise ConfigError(f"{name!r} cannot be downloaded; {meant(name, [*SOURCES, *BY_HAND])}")
    source = SOURCES[name]
    try:
        places = provide(
            source, into, accept_terms=accept_terms, archive=archive, root=root,
            mirror=mirror or os.environ.get(MIRROR, ""),
        )  # fmt: skip
    except AgreementError as error:
        print(error)
        return 1
    for part, place in zip(source.parts, places, strict=True):
        used = " and ".join(f"domain={domain}" for domain in part.domains)
        print(f"{place} is there{f', for {used}' if used else ''}")
    return 0


def listing() -> str:
    """All there is to fetch, for people."""
    from qs3.datasets.download import BY_HAND, SOURCES

    def wrapped(text: str) -> list[str]:
        return textwrap.wrap(text, 96, initial_indent="    ", subsequent_indent="      ")

    lines = ["qs3 download NAME   (--help for more)", ""]
    for source in SOURCES.values():
        need = f" (accept_terms={source.agreement})" if source.agreement else ""
        lines.append(source.name)
        for paragraph in (
            source.title,
            f"for {', '.join(f'domain={d}' for d in source.domains) or 'qs3-generate meshes='}",
            f"size: {source.size_says}; file: {source.file}",
            f"from: {source.address}",
            f"terms: {source.terms}{need}",
        ):
            lines += wrapped(paragraph)
    for asks in dict.fromkeys(one["asks"] for one in BY_HAND.values()):
        lines += ["", f"By hand, {asks} (NAME prints how)"]
        for name, one in BY_HAND.items():
            lines += wrapped(f"{name}: {one['terms']}") if one["asks"] == asks else []
    return "\n".join(lines)
