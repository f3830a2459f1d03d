"""A picture's size is read before it is unpacked, wherever OpenCV reads one."""

from __future__ import annotations

import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest

from qs3.errors import DataError
from qs3.sensors.fit.frames import _png
from qs3.utils.pictures import check_picture, read_png
from tests.limits import memory_of_at_most


def tiny_png(width: int, height: int) -> bytes:
    """A grey PNG of 16 bits that says it is large, in about 70 bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    data = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + data


def png(*shape: int) -> bytes:
    return cv2.imencode(".png", np.zeros(shape, np.uint8))[1].tobytes()


@pytest.mark.parametrize("side", [9_000, 12_000, 30_000, 100_000])
def test_a_small_file_of_a_large_picture_is_refused(side, tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(tiny_png(side, side))
    refused = pytest.raises(DataError, match=r"a\.png has more than 6\d.* million pixels")
    with memory_of_at_most(1 << 27), refused:
        _png(path)


def test_pictures_of_a_usual_size_are_let_through(tmp_path):
    for name in ("a.png", "a.jpg", "a.bmp", "a.tiff", "a.pgm"):
        cv2.imwrite(str(tmp_path / name), np.zeros((20, 30), np.uint8))
        check_picture(tmp_path / name, 600)
        with pytest.raises(DataError, match=r"more than 0\.000599 million"):
            check_picture(tmp_path / name, 599)


@pytest.mark.parametrize("size", [(60_000, 60_000), (0, 5), (2**31 - 1, 1), (4097, 2)])
def test_a_picture_too_large_is_refused_by_its_header(size):
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"here: a PNG of \d+ x \d+ px; refused"):
            read_png(tiny_png(*size), "here")
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "are not PNG"),
        (b"GIF89a" + bytes(100), "not a PNG"),
        (png(4, 4, 3), "grey with 8 or 16 bits"),
        (png(4, 4)[:-5], "broken off"),
    ],
)
def test_what_is_no_grey_png_is_refused(data, message):
    with pytest.raises(DataError, match=f"here: .*{message}"):
        read_png(data, "here")
