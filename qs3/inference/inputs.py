"""What `qs3 predict` reads: files of clouds, or depth images.

All of them become `Sample`s, one after the other; what cannot be read is a sample that failed, and
the others go on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from qs3.classes import known_as
from qs3.datasets.clouds import SUFFIXES, CloudFile, parse_clouds, visible_files, with_depth
from qs3.datasets.cutting import Fault
from qs3.datasets.depth_images import (
    Intrinsics,
    check_intrinsics,
    read_depth,
    read_intrinsics,
    read_mask,
)
from qs3.datasets.importing import UP_AXES, turned
from qs3.datasets.pointed import point_out
from qs3.errors import ConfigError, DataError, MissingDataError, Qs3Error
from qs3.geometry.sampling import surface_sample
from qs3.meshes.io import DECLARE_UP, is_mesh, load_mesh
from qs3.utils.text_table import printable

_IMAGES = (".png", ".npy")
_ON_MESH = 8192  # points; nets take some of them, as far apart as can be
_MARGIN = 0.35  # of an object's larger side, shown around it


@dataclass(eq=False)
class Sample:
    """One object: what was read of it and, once it is predicted, what a classifier says.

    Attributes:
        name: relative to the input; name[3] is cloud 3 of a file that holds several, or object 3 of
            a depth image's mask.
        cloud: [n, 3], `axis` up; None if it failed, or when it is not needed any more.
        dropped: points left out, without depth; of a depth image the object's
            pixels without depth. None if it could not be read.
        axis: the axis of `cloud` that points up.
        label: what it is, if that is known: a class of the net's, or another word; "" if not.
        tier: of an object cut from a depth image: "clean", "hard" or "poor"; "" of other clouds.
        cautions: what was wrong when it was cut, and what is not sure about the picture.
        up: how the vertical is known: "z" or another axis of the file, "given", "planes", "level".
        picture: the depth image around the object, and the object's pixels in it.
        world_from_camera: the rotation to z up of a cloud in the frame of its camera.
        points: of the cloud; None if it could not be read.
        reason: in what it is out of range, or why it failed; "" otherwise.
        probabilities: [C] float64; None if it failed.
        cls: the likeliest class; "" if it failed.
        second: the class that another classifier names; "" without one.
    """

    name: str
    cloud: Float[np.ndarray, "n 3"] | None = None
    dropped: int | None = None
    axis: str = "z"
    label: str = ""
    tier: str = ""
    cautions: tuple[Fault, ...] = ()
    up: str = ""
    picture: tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]] | None = None
    world_from_camera: Float[np.ndarray, "3 3"] | None = None
    points: int | None = None
    reason: str = ""
    probabilities: Float[np.ndarray, " c"] | None = None
    cls: str = ""
    second: str = ""

    def __post_init__(self) -> None:
        if self.cloud is not None:
            self.points = len(self.cloud)

    @property
    def confidence(self) -> float:
        """The probability of `cls`, in [0, 1]; NaN if it failed."""
        return float("nan") if self.probabilities is None else float(self.probabilities.max())

    @property
    def upright(self) -> Float[np.ndarray, "n 3"]:
        """The cloud with z up, whatever frame a net sees it in."""
        cloud = np.empty((0, 3)) if self.cloud is None else np.asarray(self.cloud, np.float64)
        turn = self.world_from_camera
        return turned(cloud, self.axis) if turn is None else cloud @ turn.T

    def failed(self, error: Qs3Error | str, file: str = "") -> Sample:
        """The same, with the reason; the file's name before it has a column of its own."""
        self.cloud, self.reason = None, printable(str(error).removeprefix(file).lstrip(" :,"))
        return self


class Inputs(NamedTuple):
    """What to read, one after the other, what one of it is called, and what to print about it."""

    units: Sequence[Callable[[], Iterator[Sample]]]
    kind: str
    notes: Sequence[str] = ()


def find_files(
    place: Path, suffixes: Sequence[str] = SUFFIXES
) -> tuple[list[Path], Path, Counter[str]]:
    """The files to read, what their names are relative to, and how many of which ending it left.

    In a folder: all files with these suffixes at any depth, in order of their names; hidden ones
    and links to folders are left out.
    """
    if place.is_file():
        return [place], place.parent, Counter()
    there = [*visible_files(place)]
    found = sorted(path for path in there if path.suffix.lower() in suffixes)
    if not found:
        raise MissingDataError(f"{place} holds no file of {' '.join(suffixes)}")
    return found, place, Counter(path.suffix for path in {*there} - {*found})


def clouds(place: Path, up: str, classes: Sequence[str]) -> Inputs:
    """The clouds of files.

    A cloud's label is that of its file, where numbers count the classes from 0, else the nearest
    folder below `place` that is called as a class.
    """
    if up not in UP_AXES:
        raise ConfigError(f"up={up}: give one of {' '.join(UP_AXES)}")
    if (place / "manifest.csv").is_file():  # its other arrays are clouds, too
        place = place / "points.npy"
    files, root, others = find_files(place)
    left = ", ".join(f"{n} {end or 'without ending'}" for end, n in others.items())
    units = [partial(clouds_of, path, root, up, classes) for path in files]
    return Inputs(units, "file", [f"passed over: {left}"] if left else [])


def clouds_of(
    path: Path, root: Path, axis: str, classes: Sequence[str], on_mesh: int = _ON_MESH
) -> Iterator[Sample]:
    """The clouds of a file; of a mesh so many samples of its surface: vertices lie at corners."""
    name = printable(path.relative_to(root).as_posix())
    folders = [known_as(part, classes) for part in path.relative_to(root).parts[:-1]]
    folder = next((cls for cls in reversed(folders) if cls), "")
    try:
        if is_mesh(path):
            mesh, rng = load_mesh(path), np.random.default_rng(0)
            found = CloudFile((surface_sample(mesh.vertices, mesh.faces, on_mesh, rng),))
            axis = "z" if path.suffix.lower() in DECLARE_UP else axis
        else:
            found = parse_clouds(path)
    except DataError as error:
        yield Sample(name, label=folder).failed(error, str(path))
        return
    for i, given in enumerate(found.clouds):
        own = f"{name}[{i}]" if found.many else name
        label = _label(found.labels[i], classes) if found.labels is not None else folder
        try:
            cloud, dropped = with_depth(given, own)
            yield Sample(own, cloud, dropped, axis, label, up=axis)
        except DataError as error:
            yield Sample(own, dropped=len(given), label=label, points=0).failed(error, own)


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
        intrinsics, scale_m: see `qs3.datasets.depth_images`.
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

    def read(path: Path, own: Path | None) -> Iterator[Sample]:
        name = printable(path.name)
        try:
            if (own is None) == (box is None):
                raise DataError("a depth image takes a mask (of its name, in a folder) or a box")
            image = read_depth(path, scale_m, camera.depth_scale)
            numbers = None if own is None else read_mask(own)
            yield from pointed(name, image, camera, numbers, box, way, gravity)
        except Qs3Error as error:
            yield Sample(name).failed(str(error).removeprefix(str(path)), name)

    return Inputs([partial(read, path, own) for path, own in pairs.items()], "depth image")


def pointed(
    name: str,
    depth_m: Float[np.ndarray, "h w"],
    given: Intrinsics,
    mask: np.ndarray | None,
    box: Sequence[float] | None,
    up: Sequence[float] | None,
    gravity: str,
) -> Iterator[Sample]:
    """The objects of a mask, one a number, or of a box; see `qs3.datasets.pointed.point_out`."""
    doubt = check_intrinsics(given, depth_m, name or "the depth image")
    found = point_out(depth_m, given.camera, mask=mask, box=box, up=up)
    unsure = [Fault("camera", doubt)] if doubt else []
    if given.bent:
        unsure.append(Fault("lens", "the camera's distortion is known and not corrected"))
    for one in found:
        sample = Sample(
            name + one.name,
            one.cloud(gravity),
            one.without_depth,
            tier=one.tier,
            cautions=(*one.cautions, *unsure),
            up=one.up,
            picture=around(depth_m, one.mask),
            world_from_camera=one.world_from_camera if gravity == "none" else None,
        )
        yield sample.failed(one.why) if one.why else sample


def around(
    depth_m: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Copies of the part of both that is shown: a frame need not be kept for one object."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    side = max(np.ptp(rows), np.ptp(columns)) + 1
    half = int(side * (0.5 + _MARGIN)) + 4
    v, u = (int(rows[0] + rows[-1]) // 2, int(columns[0] + columns[-1]) // 2)
    at = slice(max(v - half, 0), v + half), slice(max(u - half, 0), u + half)
    return depth_m[at].copy(), mask[at].copy()


def _label(given: object, classes: Sequence[str]) -> str:
    """A class of the net's if it is one by its name or, of whole numbers, by its place."""
    if isinstance(given, int) and not isinstance(given, bool):
        return classes[given] if 0 <= given < len(classes) else str(given)
    words = given.decode(errors="replace") if isinstance(given, bytes) else str(given)
    return known_as(words, classes) or printable(words)
