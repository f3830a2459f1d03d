"""What `qs3 predict` is given: files of clouds, an archive of cut objects, or depth images.

All of them become `Sample`s, one after the other; what cannot be read becomes a failed `Row`, and
the others go on.
"""

from __future__ import annotations

import functools
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from qs3.classes import known_as
from qs3.datasets.clouds import SUFFIXES, CloudFile, parse_clouds, with_depth
from qs3.datasets.cutting import Piece, faults
from qs3.datasets.depth_images import (
    check_intrinsics,
    off_centre,
    read_depth,
    read_intrinsics,
    read_mask,
)
from qs3.datasets.object_archive import ADAPT, JUDGE, Archive
from qs3.datasets.pointed import RULES, Caution, Pointed, point_out
from qs3.errors import DataError, MissingDataError, Qs3Error
from qs3.geometry.sampling import surface_sample
from qs3.inference.depth_list import IMAGES, Shown
from qs3.inference.table import Row
from qs3.meshes.io import SUFFIXES as MESHES
from qs3.meshes.io import is_mesh, load_mesh
from qs3.utils.plural import counted
from qs3.utils.text_table import printable

ALL = "all"
"""For `part=`: every object of an archive."""

Z = "z"
_ENDINGS = 10  # of files that are passed over, by name
_ON_MESH = 8192  # points; nets take some of them, as far apart as can be


class Sample(NamedTuple):
    """A cloud as read, and what is known of it; see `Row`.

    Attributes:
        name: in the table.
        cloud: [n, 3], `axis` up.
        dropped: points that were left out.
        axis: that points up in it.
        picture: the depth image and the object's pixels in it; None if it comes from none.
        drawn: whether its points were drawn on the surface of a mesh.
        world_from_camera: the rotation to z up of a cloud in the frame of its camera; None: `axis`
            says which way is up.
    """

    name: str
    cloud: np.ndarray
    dropped: int
    axis: str = Z
    label: str = ""
    tier: str = ""
    cautions: tuple[Caution, ...] = ()
    up: str = Z
    picture: tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]] | None = None
    drawn: bool = False
    world_from_camera: Float[np.ndarray, "3 3"] | None = None

    def row(self, reason: str, probabilities: np.ndarray | None) -> Row:
        """Its row of the table, with the net's prediction or the reason why there is none."""
        return Row(
            self.name,
            len(self.cloud),
            self.dropped,
            reason,
            probabilities,
            self.label,
            self.tier,
            self.cautions,
            self.up,
            drawn=self.drawn,
        )


Unit = Callable[[], Iterator[Sample | Row]]
"""Reads one file, one depth image or one object of an archive."""


def find_files(
    place: str | Path, key: str = "input=", suffixes: Sequence[str] = SUFFIXES
) -> tuple[list[Path], Path, Counter[str]]:
    """The files to read, what their names are relative to, and how many of which ending it left.

    In a folder: all files of known formats at any depth, in order of their names; hidden ones and
    links to folders are left out. `key` stands before the place in messages; `suffixes` are those
    of the formats.

    Raises:
        MissingDataError: nothing there.
        DataError: one file, of an unknown format; a folder that cannot be looked into.
    """
    place = Path(place).expanduser()
    if place.is_file():
        if place.suffix.lower() not in suffixes:
            hint = _instead(place.suffix.lower()) if key == "input=" else ""
            raise DataError(f"{key}{place}: unknown format; known are {', '.join(suffixes)}{hint}")
        return [place], place.parent, Counter()
    if not place.is_dir():
        raise MissingDataError(f"{key}{place} is not there")
    found: list[Path] = []
    others: Counter[str] = Counter()
    for folder, folders, names in os.walk(place, onerror=_unreadable):
        folders[:] = sorted(f for f in folders if not f.startswith(".") and f != "__MACOSX")
        for name in sorted(names):
            if name.startswith("."):
                continue
            if (suffix := os.path.splitext(name)[1].lower()) in suffixes:
                found.append(Path(folder) / name)
            else:
                others[suffix] += 1
    if not found:
        raise MissingDataError(f"{key}{place} holds no file of {' '.join(suffixes)}")
    return sorted(found), place, others


def passed_over(others: Mapping[str, int]) -> str:
    """Files of kinds that are not read, by their endings; meshes with what to do."""
    most = Counter(others).most_common()
    shown = ", ".join(
        f"{printable_name(suffix) or 'without ending'} {n}" for suffix, n in most[:_ENDINGS]
    )
    shown += ", ..." * (len(most) > _ENDINGS)
    files = counted(sum(others.values()), "file of another kind", "files of other kinds")
    scan = "; meshes are scanned first: qs3-generate meshes=FOLDER"
    return f"{files} passed over: {shown}" + scan * any(suffix in MESHES for suffix in others)


def _unreadable(error: OSError) -> None:
    """Stops `os.walk`, which would leave the folder out without a word."""
    raise DataError(f"{error.filename} cannot be read ({error.strerror})") from error


def _instead(suffix: str) -> str:
    """What is done with files of another kind, for a message."""
    if suffix in MESHES:
        return (
            ". A mesh is scanned first: qs3-generate meshes=FOLDER, or qs3.generate(mesh) in Python"
        )
    if suffix in IMAGES:
        return ". For depth images there is depth=FILE"
    return ". Rows of x y z are .txt or .xyz" if suffix == ".csv" else ""


def cloud_units(files: Sequence[Path], root: Path, axis: str, classes: Sequence[str]) -> list[Unit]:
    """One a file, named relative to `root`.

    A cloud's label is that of its file, where numbers count the classes from 0, else the nearest
    folder below `root` that is called as a class.
    """
    return [functools.partial(_clouds, path, root, axis, classes) for path in files]


def archive_part(archive: Archive, part: str) -> tuple[list[int], str]:
    """Positions of the objects of a part of an archive, and in words which part was taken.

    Without a part: `adapt` where there is one, else all but `judge`, which is looked at once.
    `part=all` takes everything.

    Raises:
        ConfigError: it has no such part.
    """
    parts = archive.parts
    part = part or (ADAPT if ADAPT in parts else "")
    if part and (part != ALL or ALL in parts):
        chosen, taken = archive.of_part(part), f"part {part}"
    elif part != ALL and JUDGE in parts:
        chosen, taken = np.flatnonzero(archive.dev != JUDGE).tolist(), f"all but part {JUDGE}"
    else:
        chosen, taken = list(range(len(archive))), "all objects"
    if not parts:
        return chosen, ""
    counts = ", ".join(f"{name} {count}" for name, count in parts.items())
    others = f"its parts: {counts}; part=NAME or part={ALL} takes others"
    return chosen, f"{taken} of {archive.path.name} ({others})"


def archive_units(archive: Archive, chosen: Sequence[int], classes: Sequence[str]) -> list[Unit]:
    """One an object of the archive, of those in `chosen`; no stray points."""
    return [functools.partial(_object, archive, i, classes) for i in chosen]


def depth_units(shown: Sequence[Shown], gravity: str, classes: Sequence[str]) -> list[Unit]:
    """One a row of the list; clouds stay in the camera's frame if the net's `gravity` is "none"."""
    return [functools.partial(_pointed, one, gravity, classes) for one in shown]


def _clouds(path: Path, root: Path, axis: str, classes: Sequence[str]) -> Iterator[Sample | Row]:
    name = printable_name(path.relative_to(root).as_posix())
    folders = [known_as(part, classes) for part in path.relative_to(root).parts[:-1]]
    folder = next((cls for cls in reversed(folders) if cls), "")
    mesh = is_mesh(path)
    try:
        found = CloudFile((_on_surface(path),)) if mesh else parse_clouds(path)
    except DataError as error:
        yield Row(name, None, None, reason_of(error, str(path)), None, folder)
        return
    for i, given in enumerate(found.clouds):
        own = f"{name}[{i}]" if found.many else name
        label = _label(found.labels[i], classes) if found.labels is not None else folder
        try:
            cloud, dropped = with_depth(given, own)
        except DataError as error:
            yield Row(own, 0, len(given), reason_of(error, own), None, label)
            continue
        yield Sample(own, cloud, dropped, axis, label, up=axis, drawn=mesh)


def _on_surface(path: Path) -> Float[np.ndarray, "n 3"]:
    """Points on a mesh: its vertices alone lie at corners, and say little of what is between."""
    mesh = load_mesh(path)
    return surface_sample(mesh.vertices, mesh.faces, _ON_MESH, np.random.default_rng(0))


def _object(archive: Archive, index: int, classes: Sequence[str]) -> Iterator[Sample]:
    cloud = archive.cloud(index, inliers_only=True)
    extent = np.ptp(cloud, axis=0).astype(float)
    piece = Piece(
        cloud,
        np.ones(len(cloud), dtype=bool),
        len(cloud) if archive.pixels is None else int(archive.pixels[index]),
        holes=0.0,
        rim=0.0 if archive.rim is None else float(archive.rim[index]),
        occ=0.0 if archive.occ is None else float(archive.occ[index]),
        extent_m=(float(extent[0]), float(extent[1]), float(extent[2])),
    )
    tier = str(archive.tier[index])
    cautions = [Caution(one.kind, one.words) for one in faults(piece, "", RULES)]
    if tier == "hard" and not cautions:
        cautions = [Caution("otherwise hard", "the archive calls it hard")]
    yield Sample(
        f"{archive.path.name}[{index}]",
        cloud,
        archive.size(index) - len(cloud),
        label=_label(str(archive.cls[index]), classes),
        tier=tier,
        cautions=tuple(cautions) if tier == "hard" else (),
    )


def _pointed(shown: Shown, gravity: str, classes: Sequence[str]) -> Iterator[Sample | Row]:
    name, label = printable_name(shown.name), _label(shown.label, classes)
    if shown.wrong:
        yield Row(name, None, None, shown.wrong, None, label)
        return
    try:
        depth, found, unsure = _read_picture(shown)
    except Qs3Error as error:
        yield Row(name, None, None, reason_of(error, str(shown.depth)), None, label)
        return
    for one in found:
        own = name + one.name
        if one.why:
            yield Row(own, 0, one.without_depth, one.why, None, label, one.tier, up=one.up)
            continue
        yield Sample(
            own,
            one.cloud(gravity),
            one.without_depth,
            label=label,
            tier=one.tier,
            cautions=(*one.cautions, *unsure),
            up=one.up,
            picture=(depth, one.mask),
            world_from_camera=one.world_from_camera if gravity == "none" else None,
        )


def _read_picture(
    shown: Shown,
) -> tuple[Float[np.ndarray, "h w"], list[Pointed], tuple[Caution, ...]]:
    """Depth, objects, and what is not sure about the camera."""
    given = read_intrinsics(shown.intrinsics, shown.folder)
    depth = read_depth(shown.depth, shown.scale_m, given.depth_scale)
    camera = check_intrinsics(given, depth, str(shown.depth))
    mask = None if shown.mask is None else read_mask(shown.mask)
    found = point_out(depth, camera, mask=mask, box=shown.box, up=shown.up, only=shown.only)
    unsure = [Caution("camera", words)] if (words := off_centre(given, depth)) else []
    if given.bent:
        unsure.append(Caution("lens", "the camera's distortion is known and not corrected"))
    return depth, found, tuple(unsure)


def reason_of(error: Qs3Error, name: str) -> str:
    """What is wrong, without the name before it: that has a column of its own."""
    return printable(str(error).removeprefix(name).lstrip(" :,"))


def _label(given: object, classes: Sequence[str]) -> str:
    """A class of the net's if it is one by its name or, of whole numbers, by its place."""
    if isinstance(given, int) and not isinstance(given, bool):
        return classes[given] if 0 <= given < len(classes) else str(given)
    words = given.decode(errors="replace") if isinstance(given, bytes) else str(given)
    return known_as(words, classes) or printable(words)


def printable_name(name: str) -> str:
    """A file's name for tables, pages and terminals: bytes that are no UTF-8 become escapes.

    So does what is not printable: a terminal would obey it.
    """
    text = name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    return printable(text)
