"""A picture's size is read before it is unpacked, wherever OpenCV reads one."""

from __future__ import annotations

import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest

from qs3.errors import DataError
from qs3.utils.pictures import read_png
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
    refused = pytest.raises(DataError, match=r"a\.png: a PNG of .* px; refused")
    with memory_of_at_most(1 << 27), refused:
        read_png(path.read_bytes(), str(path))


def test_a_part_that_promises_more_than_there_is_takes_no_memory(tmp_path):
    path, data = tmp_path / "a.png", bytearray(tiny_png(8, 6))
    data[33:37] = (0xFEFFFF00).to_bytes(4, "big")  # of the compressed rows
    path.write_bytes(data)
    with memory_of_at_most(1 << 27), pytest.raises(DataError, match=r"a\.png: .* broken off"):
        read_png(path.read_bytes(), str(path))


def test_a_picture_of_another_kind_is_named_in_words():
    colours = r"here: the PNG is in colours{}, with 8 bits; expected grey with 8 or 16 bits"
    with pytest.raises(DataError, match=colours.format("")):
        read_png(png(4, 5, 3), "here")
    with pytest.raises(DataError, match=colours.format(" with transparency")):
        read_png(png(4, 5, 4), "here")


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
        (png(4, 4)[:33] + tiny_png(60_000, 60_000)[8:], "several headers"),
    ],
)
def test_what_is_no_grey_png_is_refused(data, message):
    with pytest.raises(DataError, match=f"here: .*{message}"):
        read_png(data, "here")
