"""Pictures whose size is judged by the header alone: unpacked, 91 bytes can be gigabytes."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from qs3.errors import DataError

MAX_PNG_BYTES = 1 << 26
_MAX_SIDE_PX = 4096  # of a PNG
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER = struct.Struct(">8sI4sIIBBBBB")
_END = b"\0\0\0\0IEND\xaeB`\x82"
_GREY = 0
_KINDS = {
    _GREY: "grey",
    2: "in colours",
    3: "in the colours of a palette",
    4: "grey with transparency",
    6: "in colours with transparency",
}


def png_bytes(path: Path) -> bytes:
    """What a PNG file holds.

    Raises:
        DataError: it cannot be read, or is too large.
    """
    try:
        if path.stat().st_size > MAX_PNG_BYTES:
            raise DataError(f"{path}: the PNG has more than {MAX_PNG_BYTES} bytes; refused")
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror or error})") from error


def read_png(data: bytes, where: str) -> np.ndarray:
    """[h, w] uint8 or uint16 from a grey PNG, its size judged before it is unpacked.

    Raises:
        DataError: another kind of picture, too large, or damaged; begins with `where`.
    """
    width, height, bits, colour = png_header(data, where)
    if colour != _GREY or bits not in (8, 16):
        kind = _KINDS.get(colour, f"of type {colour}")
        raise DataError(
            f"{where}: the PNG is {kind}, with {bits} bits; expected grey with 8 or 16 bits"
        )
    import cv2

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
    if len(data) > MAX_PNG_BYTES:
        raise DataError(f"{where}: the PNG has more than {MAX_PNG_BYTES} bytes; refused")
    if len(data) < _HEADER.size:
        raise DataError(f"{where}: {len(data)} bytes are not PNG")
    signature, length, kind, width, height, bits, colour, *_ = _HEADER.unpack_from(data)
    if signature != _SIGNATURE or kind != b"IHDR" or length != 13:
        raise DataError(f"{where}: not a PNG")
    if not (1 <= width <= _MAX_SIDE_PX and 1 <= height <= _MAX_SIDE_PX):
        raise DataError(f"{where}: a PNG of {width} x {height} px; refused")
    at, headers = len(_SIGNATURE), 0
    while at < len(data):  # part by part: whatever length one names, memory would be taken for it
        headers += data[at + 4 : at + 8] == b"IHDR"
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    if headers > 1:  # a reader may take the last one's size
        raise DataError(f"{where}: the PNG has several headers; refused")
    if at > len(data) or not data.endswith(_END):
        raise DataError(f"{where}: the PNG is broken off")
    return width, height, bits, colour
