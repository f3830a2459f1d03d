"""What `qs3 predict` reads: files of clouds, an archive of cut objects, or depth images.

All of them become `Sample`s, one after the other; what cannot be read becomes a failed `Row`, and
the others go on.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from qs3.classes import known_as
from qs3.datasets.clouds import SUFFIXES, CloudFile, npy_clouds, parse_clouds, with_depth
from qs3.datasets.cutting import Piece, faults
from qs3.datasets.depth_images import (
    Intrinsics,
    check_intrinsics,
    off_centre,
    read_depth,
    read_intrinsics,
    read_mask,
)
from qs3.datasets.importing import UP_AXES
from qs3.datasets.object_archive import ADAPT, JUDGE, Archive, is_archive, read_archive
from qs3.datasets.pointed import RULES, Caution, point_out
from qs3.errors import ConfigError, DataError, MissingDataError, Qs3Error
from qs3.geometry.sampling import surface_sample
from qs3.inference.table import Row
from qs3.meshes.io import is_mesh, load_mesh
from qs3.utils.text_table import printable

ALL = "all"
"""For `part=`: every object of an archive."""

_IMAGES = (".png", ".npy")
_SEVERAL = (".npz", ".h5", ".hdf5")  # may hold several clouds, and are read to count them
_ON_MESH = 8192  # points; nets take some of them, as far apart as can be


class Sample(NamedTuple):
    """A cloud as read, and what is known of it; see `Row`.

    Attributes:
        name: in the table.
        cloud: [n, 3], `axis` up.
        dropped: points that were left out.
        axis: that points up in it.
        picture: the depth image and the object's pixels in it; None if it comes from none.
        world_from_camera: the rotation to z up of a cloud in the frame of its camera; None: `axis`
            is up.
    """

    name: str
    cloud: np.ndarray
    dropped: int
    axis: str = "z"
    label: str = ""
    tier: str = ""
    cautions: tuple[Caution, ...] = ()
    up: str = "z"
    picture: tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]] | None = None
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
        )


class Unit(NamedTuple):
    """One file, one depth image or one object of an archive: its objects, and their number.

    They are counted by what is cheap to read: masks, headers of arrays.
    """

    read: Callable[[], Iterator[Sample | Row]]
    size: Callable[[], int]


class Inputs(NamedTuple):
    """All units, what they are called, and what to print about them."""

    units: Sequence[Unit]
    kind: str
    notes: Sequence[str] = ()


def find_files(
    place: Path, suffixes: Sequence[str] = SUFFIXES
) -> tuple[list[Path], Path, Counter[str]]:
    """The files to read, what their names are relative to, and how many of which ending it left.

    In a folder: all files with these suffixes at any depth, in order of their names; hidden ones
    and links to folders are left out.

    Raises:
        MissingDataError: nothing there.
    """
    if place.is_file():
        return [place], place.parent, Counter()
    found: list[Path] = []
    others: Counter[str] = Counter()
    for folder, folders, names in os.walk(place, onerror=_stop):
        folders[:] = sorted(f for f in folders if not f.startswith(".") and f != "__MACOSX")
        for name in names:
            suffix = os.path.splitext(name)[1].lower()
            if suffix in suffixes and not name.startswith("."):
                found.append(Path(folder, name))
            elif not name.startswith("."):
                others[suffix] += 1
    if not found:
        raise MissingDataError(f"{place} holds no file of {' '.join(suffixes)}")
    return sorted(found), place, others


def _stop(error: OSError) -> None:
    """Stop `os.walk`, which would leave out a folder that cannot be read."""
    raise MissingDataError(f"{error.filename} cannot be read ({error.strerror})") from error


def passed_over(others: Mapping[str, int]) -> str:
    """How many files of which endings are not read."""
    shown = (f"{n} {printable_name(end) or 'without ending'}" for end, n in others.items())
    return f"passed over: {', '.join(shown)}"


def clouds(place: Path, up: str, part: str, classes: Sequence[str]) -> Inputs:
    """The clouds of files, or the objects of an archive.

    A cloud's label is that of its file, where numbers count the classes from 0, else the nearest
    folder below `place` that is called as a class.
    """
    if up not in UP_AXES:
        raise ConfigError(f"up={up}: give one of {' '.join(UP_AXES)}")
    if place.is_file() and is_archive(place):
        return _archive(read_archive(place), part, classes)
    if (place / "manifest.csv").is_file():  # its other arrays are clouds, too
        place = place / "points.npy"
    files, root, others = find_files(place)
    units = [
        Unit(partial(_clouds, path, root, up, classes), partial(_clouds_in, path)) for path in files
    ]
    return Inputs(units, "file", [passed_over(others)] if others else [])


def _clouds(path: Path, root: Path, axis: str, classes: Sequence[str]) -> Iterator[Sample | Row]:
    name = printable_name(path.relative_to(root).as_posix())
    folders = [known_as(part, classes) for part in path.relative_to(root).parts[:-1]]
    folder = next((cls for cls in reversed(folders) if cls), "")
    try:
        found = CloudFile((_on_surface(path),)) if is_mesh(path) else parse_clouds(path)
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
        yield Sample(own, cloud, dropped, axis, label, up=axis)


def _clouds_in(path: Path) -> int:
    """How many clouds a file holds; 1 if it cannot be read."""
    try:
        if path.suffix.lower() == ".npy":
            return npy_clouds(path) or 1
        return len(parse_clouds(path).clouds) if path.suffix.lower() in _SEVERAL else 1
    except DataError:
        return 1


def _on_surface(path: Path) -> Float[np.ndarray, "n 3"]:
    """Points on a mesh: its vertices alone lie at corners."""
    mesh = load_mesh(path)
    return surface_sample(mesh.vertices, mesh.faces, _ON_MESH, np.random.default_rng(0))


def _archive(archive: Archive, part: str, classes: Sequence[str]) -> Inputs:
    """The objects of a part of an archive, without stray points.

    Without a part: `adapt` where there is one, else all but `judge`, which is looked at once.
    """
    chosen = list(range(len(archive)))
    part = part or (ADAPT if ADAPT in archive.parts else "")
    if part and part != ALL:
        chosen, taken = archive.of_part(part), f"part {part}"
    elif not part and JUDGE in archive.parts:
        chosen, taken = np.flatnonzero(archive.dev != JUDGE).tolist(), f"all but part {JUDGE}"
    else:
        taken = "all objects"
    units = [Unit(partial(_object, archive, i, classes), partial(int, 1)) for i in chosen]
    counts = ", ".join(f"{name} {count}" for name, count in archive.parts.items())
    return Inputs(units, "object", [f"{taken} of {counts} (part=)"] if counts else [])


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


def depth_images(
    depth: Path,
    mask: Path | None,
    box: Sequence[float] | None,
    intrinsics: str,
    scale_m: float | None,
    up: str,
    gravity: str,
) -> Inputs:
    """The objects of one depth image, or of a folder of them.

    Args:
        depth: a file or a folder.
        mask: likewise; those of a folder have the names of their depth images. Or:
        box: left, top, right, bottom in pixels.
        intrinsics: "fx,fy,cx,cy", or a file.
        scale_m: metres a unit; None: see `qs3.datasets.depth_images`.
        up: "x,y,z" in camera coordinates, "-y" for a level camera; "": not known.
        gravity: of the net; "none": clouds stay in the camera's frame.
    """
    camera = read_intrinsics(intrinsics)
    way = [0.0, -1.0, 0.0] if up == "-y" else [float(x) for x in up.split(",")] if up else None
    pairs: dict[Path, Path | None] = {depth: mask}
    if depth.is_dir():
        if mask is None:
            raise ConfigError(f"depth={depth} is a folder: give mask=FOLDER, masks of its names")
        masks = {path.stem: path for path in mask.iterdir() if path.suffix.lower() in _IMAGES}
        pairs = {path: masks.get(path.stem) for path in find_files(depth, _IMAGES)[0]}
    units = [
        Unit(
            partial(_pointed, path, own, box, camera, scale_m, way, gravity),
            partial(_objects_in, own),
        )
        for path, own in pairs.items()
    ]
    return Inputs(units, "depth image")


def _pointed(
    path: Path,
    mask: Path | None,
    box: Sequence[float] | None,
    given: Intrinsics,
    scale_m: float | None,
    up: Sequence[float] | None,
    gravity: str,
) -> Iterator[Sample | Row]:
    name = printable_name(path.name)
    try:
        if (mask is None) == (box is None):
            raise DataError("a depth image takes a mask (of its name, in a folder) or a box")
        depth = read_depth(path, scale_m, given.depth_scale)
        camera = check_intrinsics(given, depth, str(path))
        numbers = None if mask is None else read_mask(mask)
        found = point_out(depth, camera, mask=numbers, box=box, up=up)
    except Qs3Error as error:
        yield Row(name, None, None, reason_of(error, str(path)), None)
        return
    unsure = [Caution("camera", words)] if (words := off_centre(given, depth)) else []
    if given.bent:
        unsure.append(Caution("lens", "the camera's distortion is known and not corrected"))
    for one in found:
        own = name + one.name
        if one.why:
            yield Row(own, 0, one.without_depth, one.why, None, tier=one.tier, up=one.up)
            continue
        yield Sample(
            own,
            one.cloud(gravity),
            one.without_depth,
            tier=one.tier,
            cautions=(*one.cautions, *unsure),
            up=one.up,
            picture=(depth, one.mask),
            world_from_camera=one.world_from_camera if gravity == "none" else None,
        )


def _objects_in(mask: Path | None) -> int:
    """How many objects a mask marks; 1 if it cannot be read, and in a box."""
    try:
        return int((np.unique(read_mask(mask)) != 0).sum()) if mask else 1
    except Qs3Error:
        return 1


def drawn(units: Sequence[Unit], count: int) -> list[Unit]:
    """The same with `count` of their objects, drawn at random, always the same."""
    sizes = [unit.size() for unit in units]
    ends = np.cumsum(sizes)
    chosen = np.random.default_rng(0).choice(ends[-1], min(count, ends[-1]), replace=False)
    kept = []
    for unit, size, end in zip(units, sizes, ends, strict=True):
        wanted = {int(i - (end - size)) for i in chosen if end - size <= i < end}
        if wanted:
            kept.append(Unit(partial(_some, unit, wanted, size), partial(len, wanted)))
    return kept


def _some(unit: Unit, wanted: set[int], size: int) -> Iterator[Sample | Row]:
    found = list(unit.read())
    damaged = len(found) != size
    yield from (one for i, one in enumerate(found) if damaged or i in wanted)


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
    """A file's name for tables, pages and terminals: what is not UTF-8 or printable is escaped."""
    return printable(name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace"))
