"""`qs3 view`: from paths to a page of clouds; what each path is, and which clouds are shown."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from qs3.config.compose import choices
from qs3.datasets.clouds import SUFFIXES, checked
from qs3.datasets.importing import turned
from qs3.datasets.object_archive import JUDGE, is_archive, read_archive
from qs3.errors import DataError, MissingDataError
from qs3.inference.inputs import clouds_of, find_files
from qs3.meshes.io import SUFFIXES as MESHES
from qs3.report.datasets import chosen, open_named, part_of
from qs3.report.run_page import is_run, read_run, worst_clouds
from qs3.report.viewer import Part, Shown, drawn, page, points_each
from qs3.store.meta import is_finished
from qs3.utils.progress import progress_bar


class Wanted(NamedTuple):
    """What is shown of each path; see `qs3 view --help`."""

    match: str
    up: str
    variant: str
    data_dir: Path | None
    points: int | None


def view(paths: Sequence[str], clouds: int, wanted: Wanted) -> tuple[str, list[str], list[str]]:
    """The page, what is on it, and what could not be read, a line each."""
    share = max(1, clouds // len(paths))
    parts = [_part(path, share, wanted) for path in paths]
    title = ", ".join(Path(path).absolute().name for path in paths)
    failed = [words for part in parts for words in part.failed]
    return page(title, parts, wanted.points), [part.about for part in parts], failed


def _part(path: str, most: int, wanted: Wanted) -> Part:
    place = Path(path).expanduser()
    if is_finished(place) or (not place.exists() and path in choices("domain")):
        given = {"variant": wanted.variant, "paths.data_dir": str(wanted.data_dir or "")}
        opened = open_named(path, {key: value for key, value in given.items() if value})
        return part_of(opened, chosen(opened.data, most, wanted.match))
    if is_run(place):
        return worst_clouds(read_run(place), most, wanted.match, wanted.data_dir)
    if not place.exists():
        raise MissingDataError(f"{path} is neither there nor the name of a domain")
    return _archive(place, most, wanted) if is_archive(place) else _files(place, most, wanted)


def _archive(path: Path, most: int, wanted: Wanted) -> Part:
    archive = read_archive(path)
    names = [f"{archive.cls[i]}/{i}" for i in range(len(archive))]
    open_ = archive.dev != JUDGE  # that one is looked at once for a rule, by `qs3 report judge`
    there = np.flatnonzero([wanted.match in name for name in names] & open_)
    some = drawn(there, most)
    shown = [
        Shown(
            names[i],
            archive.cloud(i),
            label=str(archive.cls[i]),
            note=", ".join(dict.fromkeys((str(archive.sub[i]), str(archive.tier[i])))),
        )
        for i in sorted(some, key=lambda i: str(archive.cls[i]))
    ]
    without = "" if open_.all() else f" without the part {JUDGE}"
    return Part(shown, f"{len(shown)} of {open_.sum()} objects of {path.name}{without}", unit="m")


def _files(place: Path, most: int, wanted: Wanted) -> Part:
    files, root, _ = find_files(place, (*SUFFIXES, *MESHES))
    names = [path.relative_to(root).as_posix() for path in files]
    few = drawn(np.flatnonzero([wanted.match in name for name in names]), most)
    shown: list[Shown] = []
    failed: list[str] = []
    each = points_each(len(few), wanted.points)
    with progress_bar("files", total=len(few)) as advance:
        for i in few:
            for one in clouds_of(files[i], root, wanted.up, (), each):
                try:
                    if one.cloud is None:
                        raise DataError(one.reason)
                    cloud = turned(checked(one.cloud, one.name), one.axis)
                except DataError as error:
                    failed.append(f"{one.name}: {error}")
                    continue
                label = one.label or Path(one.name).parent.name
                lost = f"{one.dropped} points without depth left out" if one.dropped else ""
                shown.append(Shown(one.name, cloud, label=label, note=lost))
            advance()
    about = place.name if place.is_file() else f"{len(few)} of {len(files)} files in {place.name}"
    kept = [shown[i] for i in drawn(np.arange(len(shown)), most)]
    return Part(kept, f"{about}, {len(kept)} of {len(shown)} clouds", failed=failed)
