"""ScanNet's zips of mask images: 8-bit instances, 16-bit labels, one PNG a frame.

`<scene>_2d-instance-filt.zip` holds `instance-filt/<frame>.png`, `<scene>_2d-label-filt.zip` holds
`label-filt/<frame>.png`; frames are counted from 0 as in the `.sens`, and an image has the colour
camera's resolution. What the pixels mean is in `labels.py`.

A zip is not trusted: nothing is unpacked to the disk, other names are passed over, and a picture's
size is read and judged before the picture is unpacked.
"""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np

from qs3.data.scannet.sens import MAX_SIDE_PX
from qs3.errors import DataError

INSTANCES, LABELS = "instance-filt", "label-filt"

_MAX_MEMBERS = 1_000_000
_MAX_PNG_BYTES = 1 << 26
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER = struct.Struct(">8sI4sIIBBBBB")
_GREY = 0
_BROKEN = (
    zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, struct.error,
    OSError, EOFError, NotImplementedError, RuntimeError, ValueError, OverflowError,
    LookupError,  # a name that begins with NUL
)  # fmt: skip


class MaskArchive:
    """An open zip of masks; a context manager."""

    def __init__(self, path: str | Path, folder: str) -> None:
        """Open the zip; `folder` of the masks in it is `INSTANCES` or `LABELS`.

        Raises:
            DataError: it is damaged, or holds no masks or two of a frame.
        """
        self.path = Path(path)
        try:
            self._zip = zipfile.ZipFile(self.path)
        except _BROKEN as error:
            raise DataError(f"{path} cannot be read ({error}); download it again") from error
        try:
            self._members = self._look_through(folder)
        except BaseException:
            self._zip.close()
            raise

    @property
    def frames(self) -> frozenset[int]:
        """The frames that have a mask."""
        return frozenset(self._members)

    def __enter__(self) -> MaskArchive:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    def read(self, frame: int) -> np.ndarray:
        """[h, w] uint8 or uint16, the mask of a frame; DataError if none, or as `read_png`."""
        where = f"{self.path}, frame {frame}"
        member = self._members.get(frame)
        if member is None:
            raise DataError(f"{where}: there is no mask")
        try:
            with self._zip.open(member) as file:
                data = file.read(_MAX_PNG_BYTES + 1)  # whatever size the zip claims
        except _BROKEN as error:
            raise DataError(f"{where} cannot be unpacked ({error})") from error
        return read_png(data, where)

    def _look_through(self, folder: str) -> dict[int, zipfile.ZipInfo]:
        infos = self._zip.infolist()
        if len(infos) > _MAX_MEMBERS:
            raise DataError(f"{self.path} claims {len(infos)} files; it is not a zip of masks")
        pattern = re.compile(rf"(?:[\w-]+/)?{re.escape(folder)}/(\d{{1,7}})\.png")
        found: dict[int, zipfile.ZipInfo] = {}
        for info in infos:
            if match := pattern.fullmatch(info.filename):
                frame = int(match[1])
                if found.setdefault(frame, info) is not info:
                    raise DataError(f"{self.path} holds two masks of frame {frame}")
        if not found:
            raise DataError(f"{self.path} holds no {folder}/<frame>.png")
        return found


def read_png(data: bytes, where: str) -> np.ndarray:
    """[h, w] uint8 or uint16 from a grey PNG, its size judged before it is unpacked.

    Raises:
        DataError: another kind of picture, too large, or damaged; begins with `where`.
    """
    width, height, bits, colour = png_header(data, where)
    if colour != _GREY or bits not in (8, 16):
        raise DataError(f"{where}: expected grey with 8 or 16 bits, not type {colour}, {bits}")
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise DataError(f"{where}: the PNG cannot be read ({error})") from error
    dtype = np.uint8 if bits == 8 else np.uint16
    if image is None or image.shape != (height, width) or image.dtype != dtype:
        raise DataError(f"{where}: the PNG cannot be read")
    return image


def png_header(data: bytes, where: str) -> tuple[int, int, int, int]:
    """Width, height, bits and type of colour (0 grey, 2 RGB, 3 palette, 4 and 6 with alpha).

    Raises:
        DataError: no PNG, a broken one, or one with a side of more than 4096 px or none.
    """
    if len(data) > _MAX_PNG_BYTES:
        raise DataError(f"{where}: the PNG has more than {_MAX_PNG_BYTES} bytes; refused")
    if len(data) < _HEADER.size:
        raise DataError(f"{where}: {len(data)} bytes are not PNG")
    signature, length, kind, width, height, bits, colour, *_ = _HEADER.unpack_from(data)
    if signature != _SIGNATURE or kind != b"IHDR" or length != 13:
        raise DataError(f"{where}: not a PNG")
    if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
        raise DataError(f"{where}: a PNG of {width} x {height} px; refused")
    if not data.endswith(b"IEND\xaeB`\x82"):
        raise DataError(f"{where}: the PNG is broken off")
    return width, height, bits, colour
