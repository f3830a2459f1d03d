"""ScanNet's zips of mask images: 8-bit instances, 16-bit labels, one PNG a frame.

`<scene>_2d-instance-filt.zip` holds `instance-filt/<frame>.png`, `<scene>_2d-label-filt.zip` holds
`label-filt/<frame>.png`; frames are counted from 0 as in the `.sens`, and an image has the colour
camera's resolution. What the pixels mean is in `labels.py`.

A zip is not trusted: nothing is unpacked to the disk, other names are passed over, and a picture's
size is read and judged before the picture is unpacked.
"""

from __future__ import annotations

import lzma
import re
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np

from qs3.errors import DataError
from qs3.utils.pictures import MAX_PNG_BYTES, read_png

INSTANCES, LABELS = "instance-filt", "label-filt"

_MAX_MEMBERS = 1_000_000
_BROKEN = (
    zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, lzma.LZMAError, struct.error,
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
                data = file.read(MAX_PNG_BYTES + 1)  # whatever size the zip claims
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
