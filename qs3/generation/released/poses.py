"""The object and camera poses that the authors published, as one small table.

`pose_params.tar.gz` of the release holds one pickled dict a shape in a .npy file,
`pose_params/5_view/<class>/<split>/<name>.npy`. It is untrusted: in one pass,
without unpacking it to the disk, by a reader that runs nothing (qs3.generation.released.pickles).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from qs3.classes import ALIASES, CLASSES
from qs3.errors import DataError, MissingDataError
from qs3.generation.released.pickles import load_npy_object
from qs3.geometry.cameras import rotation_xyz
from qs3.utils.plural import counted
from qs3.utils.tars import DAMAGE, is_whole, members_of, open_tar

SPLITS = ("train", "test")
_MAX_SHAPES = 200_000
_MAX_MEMBER = 1 << 16  # the released ones have 1,410 bytes
_MAX_VIEWS = 64
_CAMERA = {
    **{"camera_lens": 50.0, "camera_sensor_width": 36.0},
    **{"camera_shift_x": 0.0, "camera_shift_y": 0.0},
}


@dataclass(frozen=True, eq=False)
class Pose:
    """Where one object and its cameras stood.

    Attributes:
        scale: the mesh is multiplied by this first ...
        yaw_rad: ... then turned about z ...
        location_m: ... then moved by this, [3].
        world_from_camera: [V, 4, 4], our convention (qs3.geometry.cameras).
    """

    scale: float
    yaw_rad: float
    location_m: np.ndarray
    world_from_camera: np.ndarray


@dataclass(frozen=True, eq=False)
class PoseTable:
    """The poses of many shapes: plain arrays, so that sending them to a worker is cheap.

    Attributes:
        ids: sorted, "class/split/name" with our names of classes.
        objects: [N, 5] float64: scale, yaw (rad), location (m).
        cameras: [N, V, 6] float64: location (m) and Euler angles (rad) as Blender has them: XYZ
            order, looking along -z with y up.
    """

    ids: tuple[str, ...]
    objects: np.ndarray
    cameras: np.ndarray

    @property
    def views(self) -> int:
        """Cameras a shape."""
        return int(self.cameras.shape[1])

    @cached_property
    def sha256(self) -> str:
        """Hash of the content: the same for an archive and a folder, in any order of files."""
        digest = hashlib.sha256("\n".join(self.ids).encode())
        digest.update(self.objects.astype("<f8").tobytes())
        digest.update(self.cameras.astype("<f8").tobytes())
        return digest.hexdigest()

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {name: row for row, name in enumerate(self.ids)}

    def of(self, object_id: str) -> Pose:
        """The pose of a shape; further scans of a mesh ("id~1") have the pose of the first.

        Raises:
            DataError: there is none.
        """
        row = self._rows.get(object_id.split("~", 1)[0])
        if row is None:
            raise DataError(
                f"no pose for {object_id} in the file of poses: it has {len(self.ids)}, the first "
                f"is {self.ids[0]}. Names are joined by class, split and file name"
            )
        scale, yaw, *location = self.objects[row]
        poses = np.stack([_pose(camera) for camera in self.cameras[row]])
        return Pose(float(scale), float(yaw), np.array(location), poses)


@lru_cache(maxsize=4)
def read_poses(path: Path) -> PoseTable:
    """Read all poses below a folder or in a .tar.gz (or .tar), as released.

    Args:
        path: `pose_params.tar.gz`, or a folder with `<class>/<split>/<name>.npy` somewhere below.

    Raises:
        MissingDataError: it is not there, or holds no pose.
        DataError: a file is damaged, is of another format, is a link or leads out of the archive,
            or asks for more than numbers.
    """
    if not path.exists():
        raise MissingDataError(
            f"there is no file or folder of poses at {path}: poses= wants pose_params.tar.gz of "
            "the release, or a folder with class/split/name.npy"
        )
    rows: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for name, data in _folder(path) if path.is_dir() else _archive(path):
        where = f"{path}: {name}"
        key = _id_of(PurePosixPath(name), where)
        if key in rows:
            raise DataError(f"{where}: a second file for {key}")
        rows[key] = _row(load_npy_object(data, where), where)
        if len(rows) > _MAX_SHAPES:
            raise DataError(f"{path} holds more than {_MAX_SHAPES} poses: not read")
    if not rows:
        raise MissingDataError(f"{path} holds no class/split/name.npy with poses")
    ids = tuple(sorted(rows))
    views = {len(rows[name][1]) for name in ids}
    if len(views) != 1:
        raise DataError(
            f"{path}: some shapes have {counted(min(views), 'view')} and some {max(views)}"
        )
    return PoseTable(
        ids, np.stack([rows[name][0] for name in ids]), np.stack([rows[name][1] for name in ids])
    )


def _archive(path: Path) -> Iterator[tuple[str, bytes]]:
    try:
        with open_tar(path) as archive:  # nothing is written
            for count, member in enumerate(members_of(archive)):
                _check_name(member.name, f"{path}: {member.name}")
                if count > 2 * _MAX_SHAPES:
                    raise DataError(f"{path} has more than {2 * _MAX_SHAPES} members: not read")
                if member.isdir():
                    continue
                where = f"{path}: {member.name}"
                if not member.isreg():
                    raise DataError(f"{where} is a link or a device; only files are read")
                if member.size > _MAX_MEMBER:
                    raise DataError(
                        f"{where} has {member.size} bytes, more than {_MAX_MEMBER}: not a pose"
                    )
                if PurePosixPath(member.name).suffix != ".npy":
                    continue
                file = archive.extractfile(member)
                assert file is not None  # a regular file
                yield member.name, file.read()
            if not is_whole(archive):
                raise DataError(f"{path} is cut: its end is missing; fetch it again")
    except DAMAGE as error:
        raise DataError(f"{path} is not an archive that can be read: {error}") from error


def _folder(path: Path) -> Iterator[tuple[str, bytes]]:
    root = path.resolve()
    for file in sorted(path.rglob("*.npy")):
        name = file.relative_to(path).as_posix()
        if not file.is_file() or not file.resolve().is_relative_to(root):
            raise DataError(f"{path}: {name} is not a file, or a link that leads out of the folder")
        if file.stat().st_size > _MAX_MEMBER:
            raise DataError(f"{path}: {name} has more than {_MAX_MEMBER} bytes: not a pose")
        yield name, file.read_bytes()


def _check_name(name: str, where: str) -> None:
    parts = PurePosixPath(name).parts
    if name.startswith(("/", "\\")) or ".." in parts or "\0" in name or not name.isprintable():
        raise DataError(f"{where!r} leads out of the archive, or has odd characters: refused")


def _id_of(name: PurePosixPath, where: str) -> str:
    if len(name.parts) < 3:
        raise DataError(f"{where}: expected class/split/name.npy")
    folder, split = name.parts[-3].lower(), name.parts[-2].lower()
    cls = ALIASES.get(folder, folder)
    if cls not in CLASSES or split not in SPLITS:
        raise DataError(f"{where}: {folder}/{split} is not a class and split; expected chair/train")
    return f"{cls}/{split}/{name.stem}"


def _row(value: Any, where: str) -> tuple[np.ndarray, np.ndarray]:
    """[5] of the object and [V, 6] of the cameras, checked."""
    if not isinstance(value, dict):
        raise DataError(f"{where} holds a {type(value).__name__}, not the poses of a shape")
    scale = _numbers(value, "obj_scale", (3,), where)
    turn = _numbers(value, "obj_rotation", (3,), where)
    location = _numbers(value, "obj_location", (3,), where)
    eyes = _numbers(value, "camera_location", (None, 3), where)
    angles = _numbers(value, "camera_rotation", (None, 3), where)
    if len(eyes) != len(angles) or not 1 <= len(eyes) <= _MAX_VIEWS:
        raise DataError(f"{where}: {len(eyes)} camera locations and {len(angles)} rotations")
    if not (scale > 0).all() or np.ptp(scale) > 1e-5 * scale.max():
        raise DataError(f"{where}: obj_scale {scale} is not one positive number for all axes")
    if np.abs(turn[:2]).max() > 1e-6:
        raise DataError(f"{where}: the object is tilted ({turn}); only turns about z are known")
    for key, known in _CAMERA.items():
        said = value.get(key, known)
        if not isinstance(said, int | float | np.number) or said != known:
            shown = said if isinstance(said, float) else f"a {type(said).__name__}"
            raise DataError(f"{where}: {key} is {shown}; only the released {known} is known")
    return np.array([scale.mean(), turn[2], *location]), np.concatenate([eyes, angles], axis=1)


def _numbers(value: dict, key: str, shape: tuple[int | None, ...], where: str) -> np.ndarray:
    if key not in value:
        raise DataError(f"{where}: {key} is missing")
    try:
        array = np.asarray(value[key], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{where}: {key} is not numeric: {error}") from error
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits or not np.isfinite(array).all():
        raise DataError(f"{where}: {key} has shape {array.shape} or is not finite")
    return array


def _pose(camera: np.ndarray) -> np.ndarray:
    """[4, 4] world_from_camera of a Blender camera [6]."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_xyz(camera[3:]) @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = camera[:3]
    return pose
