"""Where in an unpacked archive the folder lies that an importer reads.

Nobody promises how the published archives are nested, so the folder is looked for by what it holds.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from qs3.errors import ConfigError, DataError

_SPLIT = r"(?i:train|test|val|validation)"

TREE = r"[^/]+/" + _SPLIT + r"/[^/]+\.{suffix}"
"""Folders class/split/name.suffix, as a pattern for `Layout.holds`."""

POINTDA_H5 = r"(?i:train|test)_\d+\.h5"
"""PointDA-10's ScanNet10."""

GRASPNET = r"(?i:train|test)/(?i:real|synthetic)/[^/]+/\d/[^/]+\.xyz"
"""GraspNetPC-10: split/origin/camera/class number/scene_frame.xyz."""


@dataclass(frozen=True)
class Layout:
    """How to know the folder that is wanted.

    Attributes:
        holds: a regular expression that its files' paths, relative to it, match.
        says: the same for people.
        named: a regular expression for the folder's own name; "" if any will do (also none: the
            archive's top).
        at_least: files that must match.
    """

    holds: str
    says: str
    named: str = ""
    at_least: int = 10

    def find(self, files: Iterable[str]) -> str:
        """The folder, relative to the top ("" is the top itself).

        Args:
            files: of the unpacked archive, relative to its top, with slashes.

        Raises:
            DataError: there is none, or there are several.
        """
        name = rf"(?:.*/)?(?i:{self.named})/" if self.named else r"(?:.*/)?"
        pattern = re.compile(rf"(?P<root>{name}){self.holds}")
        roots = Counter(found["root"] for file in files if (found := pattern.fullmatch(file)))
        large = sorted(root for root, count in roots.items() if count >= self.at_least)
        if len(large) > 1:
            raise DataError(
                f"several folders hold {self.says}: {', '.join(map(repr, large[:8]))}. Say which "
                "one is wanted with root="
            )
        if not large:
            best = f" (at most {max(roots.values())} files)" if roots else ""
            raise DataError(f"no folder holds {self.says}{best}")
        return large[0].rstrip("/")


def files_below(top: Path) -> list[str]:
    """All files below a folder, relative to it, with slashes, sorted."""
    found = []
    for folder, _, names in os.walk(top):
        relative = os.path.relpath(folder, top).replace(os.sep, "/")
        prefix = "" if relative == "." else relative + "/"
        found += [prefix + name for name in names]
    return sorted(found)


def chosen(root: str, files: Iterable[str]) -> str:
    """The folder that the person names with `root=`, checked.

    Raises:
        ConfigError: it is not in the archive.
    """
    root = root.strip("/")
    if not any(file.startswith(root + "/") for file in files):
        raise ConfigError(f"root={root}: the archive has no such folder with files")
    return root


def outline(files: Iterable[str], most: int = 12) -> str:
    """What an archive holds, for a message: folders down to the third level, with counts."""
    counts = Counter("/".join(file.split("/")[:-1][:3]) or "." for file in files)
    lines = [f"  {folder}: {count} files" for folder, count in sorted(counts.items())]
    more = [f"  ... and {len(lines) - most} folders more"] if len(lines) > most else []
    return "\n".join([*lines[:most], *more])
