"""From paths to the page: what each is, which of its clouds are shown, what is known of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.config.checks import check_choice
from qs3.config.compose import choices
from qs3.datasets.clouds.files import SUFFIXES, CloudFile, parse_clouds
from qs3.datasets.clouds.finite import checked
from qs3.datasets.importers.base import turned
from qs3.datasets.importers.folders import UP_AXES
from qs3.datasets.importers.object_archive import JUDGE, is_archive, read_archive
from qs3.datasets.with_depth import with_depth
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.geometry.sampling import surface_sample
from qs3.inference.inputs import find_files, passed_over, reason_of
from qs3.meshes.io import DECLARE_UP, is_mesh, load_mesh
from qs3.meshes.io import SUFFIXES as MESHES
from qs3.report.contact_sheets import drawn
from qs3.report.inspection.open_dataset import open_named
from qs3.report.inspection.viewed import chosen, part_of
from qs3.report.runs.data import is_run, read_run
from qs3.report.runs.viewed import part_of_run, worst_first
from qs3.report.viewer import MOST_POINTS
from qs3.report.viewer.page import Part, Shown, captions, page, points_each, thinned
from qs3.runs.unbegun import is_unbegun
from qs3.store.store import is_finished
from qs3.utils.files import write_text
from qs3.utils.plural import counted
from qs3.utils.progress import progress_bar
from qs3.utils.text_table import printable

_KNOWN = tuple(dict.fromkeys((*SUFFIXES, *MESHES)))
_PARTS = (".mtl", ".bin", ".png", ".jpg", ".jpeg")  # of meshes beside them


@dataclass(frozen=True)
class Settings:
    """Settings of one call; see `qs3 view --help`."""

    paths: tuple[str, ...]
    out: str = "view.html"
    clouds: int = 50
    points: int | None = None
    colour: str = ""
    match: str = ""
    up: str = "z"
    variant: str = ""
    residual: bool = True
    data_dir: str | None = None

    def __post_init__(self) -> None:
        if Path(self.out).suffix.lower() not in (".html", ".htm"):
            raise ConfigError(f"out={self.out} must end in .html")
        check_choice("up", self.up, UP_AXES)
        points_each(self.clouds, None)
        points_each(1, self.points)


def view_command(settings: Settings) -> tuple[str, int]:
    """Write the page.

    Returns:
        The text for the terminal, and how many files or clouds could not be read.

    Raises:
        ConfigError, MissingDataError, DataError: nothing can be shown at all.
    """
    if len(settings.paths) > settings.clouds:
        raise ConfigError(
            f"clouds={settings.clouds} is less than one for each of {len(settings.paths)} paths; "
            f"give clouds={len(settings.paths)}, or a folder, of which some are drawn"
        )
    share = settings.clouds // len(settings.paths)
    parts = [_part(path, share, settings) for path in settings.paths]
    title = ", ".join(_title(Path(path).expanduser().absolute()) for path in settings.paths)
    text = page(title, parts, colour=settings.colour, points=settings.points)
    about, notes = captions(parts, settings.points)
    out = Path(settings.out).expanduser()
    again = " (replaced what was there)" * out.exists()
    write_text(out, text)
    lines = [*about, *notes, f"saved {out}{again}, {len(text) / 1e6:.2f} MB; open it in a browser"]
    return "\n".join(lines), sum(len(part.failed) for part in parts)


def _title(place: Path) -> str:
    return f"{place.parent.name}/{place.name}" if is_run(place) else place.name


def _part(path: str, most: int, settings: Settings) -> Part:
    place = Path(path).expanduser()
    if is_finished(place):
        return _dataset(str(place), most, settings)
    if is_run(place):
        return _run(place, most, settings)
    if not place.exists():
        if path in choices("domain"):
            return _dataset(path, most, settings)
        raise MissingDataError(
            f"{path} is not there: give a file or folder of clouds, a dataset's folder, the "
            "name of a domain, or a run's folder"
        )
    if is_archive(place):
        return _archive(place, most, settings)
    if place.is_dir() and is_unbegun(place):
        raise MissingDataError(f"{place} is a run that did not finish; repeat its command")
    return _files(place, most, settings)


def _dataset(path: str, most: int, settings: Settings) -> Part:
    given = {"variant": settings.variant, "paths.data_dir": settings.data_dir}
    opened = open_named(path, {key: value for key, value in given.items() if value})
    data = opened.data
    positions = chosen(data, most, settings.match)
    _nothing_if(not positions, settings, path)
    with progress_bar("clouds", total=len(positions)) as advance:
        return part_of(opened, positions, residuals=settings.residual, advance=advance)


def _run(place: Path, most: int, settings: Settings) -> Part:
    run = read_run(place)
    positions = worst_first(run, settings.match)[:most]
    _nothing_if(not positions, settings, str(place))
    with progress_bar("clouds", total=len(positions)) as advance:
        return part_of_run(
            run, positions, settings.data_dir, residuals=settings.residual, advance=advance
        )


def _archive(path: Path, most: int, settings: Settings) -> Part:
    archive = read_archive(path)
    names = [f"{archive.cls[i]}/{i}" for i in range(len(archive))]
    open_ = archive.dev != JUDGE  # that one is looked at once for a rule, by `qs3 report judge`
    there = np.flatnonzero([settings.match in name for name in names] & open_)
    _nothing_if(not len(there), settings, str(path))
    some = np.array(drawn(there, most))
    by_class = some[np.argsort(archive.cls[some], kind="stable")]
    shown = [
        Shown(
            f"{archive.cls[i]}/{i}",
            archive.cloud(i, inliers_only=True),
            label=str(archive.cls[i]),
            note=", ".join(dict.fromkeys((str(archive.sub[i]), str(archive.tier[i])))),
        )
        for i in by_class
    ]
    without = "" if open_.all() else f" without the part {JUDGE}"
    title = f"{len(shown)} of {int(open_.sum())} objects of {path.name}{without}"
    return Part(shown, title, unit="m")


def _files(place: Path, most: int, settings: Settings) -> Part:
    files, root, others = find_files(place, key="", suffixes=_KNOWN)
    names = [path.relative_to(root).as_posix() for path in files]
    there = np.flatnonzero([settings.match in name for name in names])
    _nothing_if(not len(there), settings, str(place))
    shown: list[Shown] = []
    failed: list[str] = []
    meshes = any(path.suffix.lower() in MESHES for path in files)
    for suffix in (".html", *(_PARTS if meshes else ())):
        others.pop(suffix, None)
    few, clouds = drawn(there, most), 0
    with progress_bar("files", total=len(few)) as advance:
        for i in few:
            name = printable(names[i])
            if is_mesh(files[i]):
                count, each = 1, _of_mesh(files[i], name, settings, len(few))
            else:
                count, each = _of_file(files[i], name, most, settings.up)
            clouds += count
            for one in each:
                if isinstance(one, Shown):
                    shown.append(one)
                else:
                    failed.append(one)
                    clouds -= 1
            advance()
    shown = [shown[i] for i in drawn(np.arange(len(shown)), most)]
    about = (
        f"{len(few)} of {len(files)} files in {place.absolute().name}"
        if place.is_dir()
        else place.name
    )
    if len(shown) < clouds:
        about += f", {len(shown)} of {clouds} clouds"
    elif clouds != len(few):
        about += f", {counted(clouds, 'cloud')}"
    if others:
        about += f"; {passed_over(others)}"
    return Part(shown, about, failed=failed)


def _of_mesh(path: Path, name: str, settings: Settings, files: int) -> Iterator[Shown | str]:
    """Samples of a surface; its vertices alone show little."""
    count = points_each(files, settings.points)
    try:
        mesh = load_mesh(path)
        cloud = surface_sample(mesh.vertices, mesh.faces, count, np.random.default_rng(0))
        cloud = checked(cloud, name)
    except DataError as error:
        yield f"{name}: {reason_of(error, str(path))}"
        return
    if path.suffix.lower() not in DECLARE_UP:
        cloud = turned(cloud, settings.up)
    yield Shown(
        name, cloud, label=_folder(name), note=f"samples of {counted(len(mesh.faces), 'face')}"
    )


def _of_file(path: Path, name: str, most: int, up: str) -> tuple[int, Iterator[Shown | str]]:
    """How many clouds a file has, and some of many; or why one cannot be shown.

    A cloud's class is that of its file, else the name of the folder that the file is in.
    """
    try:
        found = parse_clouds(path)
    except DataError as error:
        return 1, iter([f"{name}: {reason_of(error, str(path))}"])
    return len(found.clouds), _clouds(found, name, most, up)


def _clouds(found: CloudFile, name: str, most: int, up: str) -> Iterator[Shown | str]:
    for i in drawn(np.arange(len(found.clouds)), most):
        own = f"{name}[{i}]" if found.many else name
        label = _folder(name) if found.labels is None else _words(found.labels[i])
        try:
            seen, dropped = with_depth(found.clouds[i], own)
            cloud = turned(checked(seen, own), up)
        except DataError as error:
            yield f"{own}: {reason_of(error, own)}"
            continue
        note = f"{counted(dropped, 'point')} without depth left out" if dropped else ""
        one = Shown(own, cloud, label=label, note=note)
        yield thinned(one, MOST_POINTS)  # of a large file nothing else stays in memory


def _folder(name: str) -> str:
    return name.rpartition("/")[0].rpartition("/")[2]


def _words(label: object) -> str:
    return printable(label.decode(errors="replace") if isinstance(label, bytes) else str(label))


def _nothing_if(nothing: bool, settings: Settings, path: str) -> None:
    if nothing:
        raise ConfigError(f"match={settings.match}: no cloud of {path} has that in its name")
