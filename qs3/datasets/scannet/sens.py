"""ScanNet's `.sens` recordings (format version 4), read one frame at a time.

Little endian, without padding: version uint32, sensor name (uint64 length, bytes), four 4x4
float32 matrices (intrinsics and extrinsics of the colour camera, then of the depth camera), colour
and depth compression int32, colour width and height, depth width and height uint32, depth shift
float32 (units a metre), number of frames uint64; each frame: camera-to-world 4x4 float32, time
stamps of colour and depth uint64, bytes of colour and of depth uint64, then those bytes. Frames
of an inertial sensor follow; they are not read.

Conventions of ScanNet's SensReader, which we rely on: matrices are row-major; the centre of the
top left pixel is at (0, 0); an extrinsic matrix takes its camera's coordinates to the base frame of
the device (typically the colour camera's, whose matrix is then the identity); camera-to-world
belongs to the depth camera, and a lost frame has -inf everywhere in it. Colour and depth of the
published scans are said to be aligned already (ScanNet issues 2 and 92), so their extrinsics should
be the identity; whatever the file holds is used.

Nothing in the file is trusted: every length is compared with what is left of the file, or with
what it must be, before anything of that length is read.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from qs3.errors import DataError

VERSION = 4
MAX_SIDE_PX = 4096
MAX_FRAMES = 1_000_000
_MAX_NAME = 4096

_START = struct.Struct("<IQ")
_HEADER = struct.Struct("<64f2i4IfQ")
_FRAME = struct.Struct("<16f4Q")
_RAW, _ZLIB, _OCCI = 0, 1, 2
_RIGID = 1e-2  # of a rotation's entries; stored as float32, they are about 1e-6 off


@dataclass(frozen=True, eq=False)
class SensHeader:
    """What holds for all frames.

    Attributes:
        colour_intrinsics, depth_intrinsics: [3, 3] float64, px; last row (0, 0, 1).
        base_from_colour, base_from_depth: [4, 4] float64 rigid: the extrinsics.
        depth_compression: 0 raw, 1 zlib (both of uint16).
        depth_shift: depth units a metre.
        frames: how many there are.
    """

    sensor: str
    colour_intrinsics: np.ndarray
    base_from_colour: np.ndarray
    depth_intrinsics: np.ndarray
    base_from_depth: np.ndarray
    colour_width_px: int
    colour_height_px: int
    depth_width_px: int
    depth_height_px: int
    depth_compression: int
    depth_shift: float
    frames: int

    @property
    def colour_from_depth(self) -> np.ndarray:
        """[4, 4] float64: coordinates in the depth camera to those in the colour camera."""
        return np.linalg.inv(self.base_from_colour) @ self.base_from_depth


class SensFile:
    """An open recording; a context manager.

    Opening it reads the header and, skipping the images, every frame's pose: a broken-off file is
    found out at once. Images are read when they are asked for, so memory is that of one frame.

    Attributes:
        header: what holds for all frames.
        poses: [frames, 4, 4] float64 world_from_depth as stored; see `has_pose`.
    """

    def __init__(self, path: str | Path) -> None:
        """Open the file; DataError (names the frame) if it is not a recording or broken off."""
        self.path = Path(path)
        try:
            self._file: BinaryIO = open(self.path, "rb")  # noqa: SIM115 (closed by close)
        except OSError as error:
            raise DataError(f"{path} cannot be read ({error.strerror})") from error
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self.header = self._read_header()
            self.poses, self._depth_at = self._read_index()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> SensFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __len__(self) -> int:
        """Number of frames."""
        return self.header.frames

    def has_pose(self, frame: int) -> bool:
        """Whether the frame's pose is finite and a rigid motion."""
        return is_rigid(self.poses[frame])

    def depth_m(self, frame: int) -> np.ndarray:
        """[h, w] float32 depth along the optical axis in metres, 0 where nothing was measured.

        Raises:
            DataError: the image is damaged; names the frame.
        """
        offset, length = self._depth_at[frame]
        where = f"{self.path}, frame {frame}"
        shape = (self.header.depth_height_px, self.header.depth_width_px)
        wanted = 2 * shape[0] * shape[1]
        if length == 0:  # as the format's own tools write a frame without depth
            return np.zeros(shape, dtype=np.float32)
        # zlib adds at most 5 bytes a block of 16 KiB, and 6 bytes
        if length > wanted + wanted // 1024 + 64:
            raise DataError(f"{where}: {length} bytes of depth for {shape[1]} x {shape[0]} px")
        self._file.seek(offset)
        data = self._read(length, where)
        if self.header.depth_compression == _ZLIB:
            data = _inflate(data, wanted, where)
        if len(data) != wanted:
            raise DataError(f"{where}: {len(data)} bytes of depth, expected {wanted}")
        raw = np.frombuffer(data, dtype="<u2").reshape(shape)
        return raw.astype(np.float32) / np.float32(self.header.depth_shift)

    def _read_header(self) -> SensHeader:
        where = f"{self.path}, header"
        version, length = _START.unpack(self._read(_START.size, where))
        if version != VERSION:
            raise DataError(f"{where}: version {version}, only {VERSION} is known; is it a .sens?")
        if length > _MAX_NAME:
            raise DataError(f"{where}: a sensor name of {length} bytes; the file is damaged")
        name = self._read(length, where).decode("utf-8", "replace")
        values = _HEADER.unpack(self._read(_HEADER.size, where))
        matrices = np.array(values[:64], dtype=np.float64).reshape(4, 4, 4)
        _, depth_compression, *sizes, depth_shift, frames = values[64:]
        for what, size in zip(("colour", "colour", "depth", "depth"), sizes, strict=True):
            if not 1 <= size <= MAX_SIDE_PX:
                raise DataError(f"{where}: the {what} image has a side of {size} px")
        if depth_compression == _OCCI:
            raise DataError(f"{where}: depth in Occipital's compression, which cannot be read")
        if depth_compression not in (_RAW, _ZLIB):
            raise DataError(f"{where}: unknown depth compression {depth_compression}")
        if not 1 <= depth_shift < np.inf:  # 1000: a depth in millimetres
            raise DataError(f"{where}: a depth shift of {depth_shift} units a metre")
        left = self._size - self._file.tell()
        if frames > MAX_FRAMES or frames * _FRAME.size > left:
            raise DataError(f"{where}: {frames} frames cannot lie in the {left} bytes that follow")
        return SensHeader(
            sensor=name,
            colour_intrinsics=_intrinsics(matrices[0], f"{where}: colour intrinsics"),
            base_from_colour=_extrinsics(matrices[1], f"{where}: colour extrinsics"),
            depth_intrinsics=_intrinsics(matrices[2], f"{where}: depth intrinsics"),
            base_from_depth=_extrinsics(matrices[3], f"{where}: depth extrinsics"),
            colour_width_px=sizes[0],
            colour_height_px=sizes[1],
            depth_width_px=sizes[2],
            depth_height_px=sizes[3],
            depth_compression=depth_compression,
            depth_shift=depth_shift,
            frames=frames,
        )

    def _read_index(self) -> tuple[np.ndarray, list[tuple[int, int]]]:
        """[frames, 4, 4] poses, and where each frame's depth lies: offset and length in bytes."""
        poses = np.empty((self.header.frames, 4, 4))
        depth_at = []
        for frame in range(self.header.frames):
            where = f"{self.path}, frame {frame} of {self.header.frames}"
            *pose, _, _, colour, depth = _FRAME.unpack(self._read(_FRAME.size, where))
            poses[frame] = np.reshape(pose, (4, 4))
            at = self._file.tell()
            left = self._size - at
            if colour + depth > left:
                raise DataError(
                    f"{where}: {colour} bytes of colour and {depth} of depth, but {left} "
                    "bytes are left: the file is damaged or broken off; download it again"
                )
            depth_at.append((at + colour, depth))
            self._file.seek(at + colour + depth)
        return poses, depth_at

    def _read(self, length: int, where: str) -> bytes:
        try:
            data = self._file.read(length)
        except OSError as error:
            raise DataError(f"{where} cannot be read ({error.strerror})") from error
        if len(data) != length:
            raise DataError(
                f"{where}: {length} bytes expected, {len(data)} there: the file is broken off; "
                "download it again"
            )
        return data


def is_rigid(matrix: np.ndarray) -> bool:
    """Whether a [4, 4] matrix is finite, a proper rotation, and a shift."""
    if not np.isfinite(matrix).all():
        return False
    rotation = matrix[:3, :3]
    near = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=_RIGID)
    last_row = np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=_RIGID)
    return bool(near and last_row and np.linalg.det(rotation) > 0)


def _intrinsics(matrix: np.ndarray, where: str) -> np.ndarray:
    """[3, 3] of a pinhole, checked."""
    k = matrix[:3, :3]
    plain = np.isfinite(k).all() and k[0, 0] > 0 and k[1, 1] > 0
    if not plain or not np.allclose(k[[1, 2, 2, 2], [0, 0, 1, 2]], (0, 0, 0, 1)):
        raise DataError(f"{where} are not those of a camera: {k.tolist()}")
    return k.copy()


def _extrinsics(matrix: np.ndarray, where: str) -> np.ndarray:
    if not is_rigid(matrix):
        raise DataError(f"{where} are not a rigid motion: {matrix.tolist()}")
    return matrix.copy()


def _inflate(data: bytes, wanted: int, where: str) -> bytes:
    """`data` unpacked to at most `wanted` bytes, however many there would be."""
    unpacker = zlib.decompressobj()
    try:
        found = unpacker.decompress(data, wanted)
        more = not unpacker.eof and bool(unpacker.decompress(unpacker.unconsumed_tail, 1))
    except zlib.error as error:
        raise DataError(f"{where}: the depth cannot be unpacked ({error})") from error
    if more or not unpacker.eof:
        raise DataError(f"{where}: the depth does not unpack to {wanted} bytes")
    return found
