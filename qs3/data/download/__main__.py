"""Fetch a published dataset and put it where its domain looks for it.

    python -m qs3.data.download                  what there is
    python -m qs3.data.download NAME [into=data] [accept_terms=WORD] [mirror=ADDRESS]
                                     [archive=PATH] [root=FOLDER] [keep=true]

  into=          the data folder, paths.data_dir of a run. Archives come to its downloads/, what
                 is in them to published/
  accept_terms=  the agreement that you have made, for what needs one (scannet)
  mirror=        base address of a copy of the archives, each under the name that the list shows;
                 also taken from the environment, QS3_DOWNLOAD_MIRROR
  archive=       unpack this file instead of fetching one, e.g. what your browser downloaded
  root=          the folder in the archive to take, where it cannot be found out
  keep=          false deletes the archive when it is unpacked

An interrupted download continues where it ended: run the same command again. What is in place is
left alone. No hashes of these files were published; zip and gzip have checksums of their own, of
ModelNet10.zip the size is known, and .download.json in the folder notes the SHA-256 of the archive.
"""

from __future__ import annotations

import logging
import os
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qs3.data.download.catalogue import BY_HAND, SOURCES, find
from qs3.errors import ConfigError, Qs3Error

MIRROR = "QS3_DOWNLOAD_MIRROR"


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit status: 0 if the data are in place afterwards."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(__doc__ if argv else listing())
        return 0
    try:
        name, options = parse(argv)
        if name in BY_HAND:
            print(BY_HAND[name])
            return 1
        source = find(name)
        from qs3.data.download.provide import AgreementError, provide

        logging.basicConfig(level=logging.INFO, format="%(message)s")
        try:
            places = provide(source, **options)
        except AgreementError as error:
            print(error)
            return 1
        for part, place in zip(source.parts, places, strict=True):
            used = " and ".join(f"domain={domain}" for domain in part.domains)
            print(f"{place} is there{f', for {used}' if used else ''}")
    except Qs3Error as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted; run the same command again and it continues", file=sys.stderr)
        return 130
    return 0


def parse(argv: Sequence[str]) -> tuple[str, dict[str, Any]]:
    """The name, and key=value words as arguments of `provide`.

    Raises:
        ConfigError: an unknown key, or a value of the wrong kind.
    """
    name, *words = argv
    if "=" in name:
        raise ConfigError(f"the name comes first, not {name!r} (python -m qs3.data.download)")
    known = ("into", "accept_terms", "mirror", "archive", "root", "keep")
    options: dict[str, Any] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or key not in known:
            raise ConfigError(
                f"unknown argument {word!r}; known are {'=, '.join(known)}= "
                "(python -m qs3.data.download --help)"
            )
        if not value:
            raise ConfigError(f"{key}= has no value")
        options[key] = Path(value) if key in ("into", "archive") else value
    if "keep" in options:
        if options["keep"].casefold() not in ("true", "false"):
            raise ConfigError(f"keep must be true or false, got {options['keep']!r}")
        options["keep"] = options["keep"].casefold() == "true"
    if "archive" not in options and (mirror := os.environ.get(MIRROR)):
        options.setdefault("mirror", mirror)
    return name, options


def listing() -> str:
    """All there is to fetch, for people."""
    lines = ["python -m qs3.data.download NAME   (--help for more)", ""]
    for source in SOURCES:
        need = f" (accept_terms={source.agreement})" if source.agreement else ""
        lines.append(source.name)
        for text in (
            source.title,
            f"for {', '.join(f'domain={d}' for d in source.domains) or 'generate.py meshes='}",
            f"size: {source.size_says}; file: {source.file}",
            f"from: {source.address}",
            f"terms: {source.terms}{need}",
        ):
            lines += textwrap.wrap(text, 96, initial_indent="    ", subsequent_indent="      ")
    lines += ["", "By hand, after an agreement (NAME prints how): " + ", ".join(BY_HAND)]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
