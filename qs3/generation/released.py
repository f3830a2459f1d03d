"""The behaviour of the authors' released code (QS3, 2022), where qs3 does better by default.

`released=yes` brings it back (conf/released); docs/reference/released.md describes its parts. Here
are its law of poses, its box around an object, and `poses=PATH`, the poses that they published.

`pose_params.tar.gz` of the release holds one pickled dict a shape in a .npy file,
`pose_params/5_view/<class>/<split>/<name>.npy`. A pickle is a program: of what it may call, only
what makes numpy's arrays is let through. Nothing is unpacked to the disk.
"""

import hashlib
import io
import pickle
import tarfile
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from qs3.classes import ALIASES, CLASSES
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.generation.camera_poses import AnchoredViews
from qs3.geometry.cameras import rotation_xyz
from qs3.meshes.mesh import Mesh
from qs3.utils.settings import NotNegative, settings

_FLIP = np.diag([1.0, -1.0, -1.0])  # Blender's cameras look along -z with y up
_SPLITS = ("train", "test")
_MAX_ERROR_M = 0.01  # of the largest side from 1 m, and of the middle from the origin
_CAMERA = {
    **{"camera_lens": 50.0, "camera_sensor_width": 36.0},
    **{"camera_shift_x": 0.0, "camera_shift_y": 0.0},
}
_ARRAYS = {
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
}


@dataclass(frozen=True, eq=False)
class PoseTable:
    """The poses of many shapes: plain arrays, so that sending them to a worker is cheap.

    Angles of cameras are Euler's as Blender has them: XYZ order, looking along -z with y up.
    """

    ids: tuple[str, ...]  # sorted, "class/split/name" with our names of classes
    objects: np.ndarray  # [N, 5] float64: scale, yaw (rad), location (m)
    cameras: np.ndarray  # [N, V, 6] float64: location (m) and angles (rad)

    @property
    def views(self) -> int:
        """Cameras a shape."""
        return int(self.cameras.shape[1])

    @cached_property
    def sha256(self) -> str:
        """Hash of the content, whatever the order of the files."""
        digest = hashlib.sha256("\n".join(self.ids).encode())
        digest.update(self.objects.astype("<f8").tobytes())
        digest.update(self.cameras.astype("<f8").tobytes())
        return digest.hexdigest()

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {name: row for row, name in enumerate(self.ids)}

    def row(self, object_id: str) -> int:
        """The number of a shape; further scans of a mesh ("id~1") have the pose of the first."""
        row = self._rows.get(object_id.split("~", 1)[0])
        if row is None:
            raise DataError(f"no pose for {object_id} in the file of poses")
        return row


@lru_cache(maxsize=4)
def read_poses(path: Path) -> PoseTable:
    """Read all poses of `pose_params.tar.gz`, as released.

    Raises:
        MissingDataError: it is not there, or holds no pose.
        DataError: a file is damaged, is of another format, or asks for more than numbers.
    """
    rows: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    name = ""
    try:
        with tarfile.open(path) as archive:
            for member in archive:
                name = member.name
                if name.endswith(".npy") and (file := archive.extractfile(member)):
                    rows[_id_of(PurePosixPath(name))] = _row(_unpickled(file.read()))
        if rows:
            ids = tuple(sorted(rows))
            objects, cameras = zip(*(rows[name] for name in ids), strict=True)
            return PoseTable(ids, np.stack(objects), np.stack(cameras))
    except FileNotFoundError as error:
        raise MissingDataError(f"poses={path}: there is no such file") from error
    except Exception as error:  # what damaged bytes raise cannot be listed
        raise DataError(f"{path}: {name} holds no poses that can be read: {error}") from error
    raise MissingDataError(f"{path} holds no class/split/name.npy with poses")


def _id_of(name: PurePosixPath) -> str:
    folder, split = name.parts[-3].lower(), name.parts[-2].lower()
    cls = ALIASES.get(folder, folder)
    assert cls in CLASSES, f"{folder} is not a class"
    assert split in _SPLITS, f"{split} is not a split"
    return f"{cls}/{split}/{name.stem}"


class _Unpickler(pickle.Unpickler):
    """Makes plain values and numpy's arrays; whatever else a pickle asks for is an error."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ARRAYS:
            raise DataError(f"its pickle asks for {module}.{name}, which is not run")
        return super().find_class(module, name)


def _unpickled(data: bytes) -> Any:
    """The value in a .npy file that numpy wrote with `allow_pickle=True` from a single object."""
    file = io.BytesIO(data)
    np.lib.format.read_magic(file)
    np.lib.format.read_array_header_1_0(file)
    return _Unpickler(file).load()[()]


def _row(value: Any) -> tuple[np.ndarray, np.ndarray]:
    """[5] of the object and [V, 6] of the cameras, of poses that mean what ours do."""
    scale, turn, location = (
        np.asarray(value[f"obj_{key}"], np.float64).reshape(3)
        for key in ("scale", "rotation", "location")
    )
    eyes, angles = (
        np.asarray(value[f"camera_{key}"], np.float64).reshape(-1, 3)
        for key in ("location", "rotation")
    )
    assert (scale > 0).all() and np.ptp(scale) <= 1e-5 * scale.max(), "not scaled alike"  # noqa: PT018
    assert np.abs(turn[:2]).max() <= 1e-6, "the object is tilted"
    for key, known in _CAMERA.items():
        assert value.get(key, known) == known, f"{key} is not the released {known}"
    row = np.array([scale.mean(), turn[2], *location])
    cameras = np.concatenate([eyes, angles], axis=1)
    assert np.isfinite(row).all(), "a number is not finite"
    assert np.isfinite(cameras).all(), "a number is not finite"
    return row, cameras


@dataclass(frozen=True, eq=False)
class ReleasedPlacing:
    """Scale, yaw and location of the released poses.

    The released scale is 1 over the largest side of the authors' mesh, and its location brings
    the middle of its box to the origin. A mesh for which that does not hold is not theirs, or is
    in other units or has another axis up; it is refused, as its views would miss it.
    """

    table: PoseTable

    def place(self, mesh: Mesh, rng: np.random.Generator, object_id: str) -> Mesh:
        """A scaled, turned and moved copy; draws nothing."""
        scale, yaw_rad, *location_m = self.table.objects[self.table.row(object_id)]
        low, high = mesh.bounds
        side = float((high - low).max()) * scale
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        middle = turn @ ((low + high) / 2 * scale) + location_m
        if abs(side - 1) > _MAX_ERROR_M or np.abs(middle).max() > _MAX_ERROR_M:
            raise DataError(
                f"this is not the mesh that was posed: its largest side is {side:.4g} m, not 1 m, "
                f"or the middle of its box is at {middle.round(3)} m, not at the origin"
            )
        return mesh.at(mesh.vertices * scale @ turn.T + location_m)


@dataclass(frozen=True, eq=False)
class ReleasedViews:
    """The cameras of the released poses."""

    table: PoseTable
    count: int = 5  # the first so many of each

    def __post_init__(self) -> None:
        if self.count > self.table.views:
            raise ConfigError(f"views={self.count}: the file of poses has {self.table.views}")

    def poses(
        self, rng: np.random.Generator, box_m: np.ndarray, object_id: str
    ) -> list[np.ndarray]:
        """`count` poses [4, 4] world_from_camera; draws nothing, and the box does not matter."""
        found = []
        for camera in self.table.cameras[self.table.row(object_id)][: self.count]:
            pose = np.eye(4)
            pose[:3, :3] = rotation_xyz(camera[3:]) @ _FLIP
            pose[:3, 3] = camera[:3]
            found.append(pose)
        return found


def pose_file(path: str | None) -> PoseTable | None:
    """The poses of a file (`read_poses`), to be sent on as a table; None without one."""
    return None if path is None else read_poses(Path(path).expanduser())


@settings
class GrowingJitterViews(AnchoredViews):
    """The poses of the released code (and, with `count` 5, of the released pose files).

    View 0 looks at the origin. View i (counted from 0) moves each coordinate of its place by a
    normal draw of sigma `shift_sigma_m * (i + 1) / count`, and each of its Euler angles (Blender's
    XYZ: added to the angles, not composed with the rotation) by one of sigma
    `turn_sigma_rad * (i + 1) / count`, all clipped; it does not aim again.

    The 5,039 released files agree: maximum likelihood of the clipped normal gives 0.0203, 0.0302,
    0.0397, 0.0503 m and 0.0399, 0.0592, 0.0800, 0.0989 rad for views 1 to 4. 31 % of the last
    view's turns are 0.1 exactly, which they could not be if the turns were composed.

    Attributes:
        min_azimuth_deg, max_azimuth_deg: of view 0, uniform; from the x axis towards y. Objects
            have a random yaw, so half a circle leaves no side of them out.
        shift_sigma_m, turn_sigma_rad: of the last view; draws above `max_shift_m` and
            `max_turn_rad` become that.
    """

    min_azimuth_deg: float = -90.0
    max_azimuth_deg: float = 90.0
    shift_sigma_m: NotNegative = 0.05
    turn_sigma_rad: NotNegative = 0.1

    def poses(
        self, rng: np.random.Generator, box_m: np.ndarray, object_id: str = ""
    ) -> list[np.ndarray]:
        """`count` poses [4, 4] world_from_camera around a box [2, 3]; the first is the anchor."""
        anchor = self.anchor(rng, box_m)
        angles = euler_xyz(anchor[:3, :3] @ _FLIP)
        poses = [anchor]
        for i in range(1, self.count):
            grown = (i + 1) / self.count
            shift = self.shift_sigma_m * grown * rng.standard_normal(3)
            turn = self.turn_sigma_rad * grown * rng.standard_normal(3)
            pose = anchor.copy()
            pose[:3, 3] += np.clip(shift, -self.max_shift_m, self.max_shift_m)
            turned = angles + np.clip(turn, -self.max_turn_rad, self.max_turn_rad)
            pose[:3, :3] = rotation_xyz(turned) @ _FLIP
            poses.append(pose)
        return poses

    def azimuth_rad(self, rng: np.random.Generator) -> float:
        """From the x axis towards y, within bounds."""
        return float(np.deg2rad(rng.uniform(self.min_azimuth_deg, self.max_azimuth_deg)))


def euler_xyz(rotation: np.ndarray) -> np.ndarray:
    """[3] angles (rad) with rotation = Rz Ry Rx, of a [3, 3] rotation; Ry within a quarter turn."""
    flat = np.hypot(rotation[0, 0], rotation[1, 0])
    return np.array(
        [
            np.arctan2(rotation[2, 1], rotation[2, 2]),
            np.arctan2(-rotation[2, 0], flat),
            np.arctan2(rotation[1, 0], rotation[0, 0]),
        ]
    )


def box_of_corners(mesh: Mesh, placed: Mesh) -> np.ndarray:
    """The axis-aligned box of the placed corners of the mesh's own box, as the released code crops.

    It holds the object's axis-aligned box and is up to sqrt(2) times as wide.

    Args:
        mesh: as it was loaded.
        placed: the same, scaled, turned and moved; vertices in the same order.

    Returns:
        [2, 3] lowest and highest corner in the world.
    """
    low, high = mesh.bounds
    middle, size = (low + high) / 2, float((high - low).max()) or 1.0

    def homogeneous(points: np.ndarray) -> np.ndarray:
        return np.column_stack([(points - middle) / size, np.ones(len(points))])

    # The placing is affine: found from the vertices, it also takes the corners along.
    moves, *_ = np.linalg.lstsq(homogeneous(mesh.vertices), placed.vertices, rcond=None)
    corners = np.stack(np.meshgrid(*np.stack([low, high]).T, indexing="ij"), axis=-1).reshape(8, 3)
    there = homogeneous(corners) @ moves
    return np.stack([there.min(axis=0), there.max(axis=0)])
