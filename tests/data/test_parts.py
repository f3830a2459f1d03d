"""Parts of unfinished datasets: one that is damaged is named, however it is."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from qs3.data.parts import PartFiles
from qs3.errors import DataError


def _zip(name: str, data: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, data)
    return file.getvalue()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK",
        _zip("points.npy", b""),
        _zip("note.npy", b"\x93NUMPY\x01\x00\x06\x00((((((" + bytes(9)),
        _zip("xote.npy", b"").replace(b"xote", b"\0ote"),
        _zip("note.npy", b"\x93NUMPY"),
    ],
    ids=["empty", "cut", "no note", "a header of brackets", "a name of nothing", "a cut header"],
)
def test_a_damaged_part_is_named(content, tmp_path):
    parts = PartFiles(tmp_path, "path")
    parts.begin({"a": 1})
    parts.write("x", {"n": 1}, {"points": np.zeros(3)})
    assert parts.read("x")[0] == {"n": 1}
    (path,) = tmp_path.rglob("x.npz")
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"x\.npz is damaged .* delete it and run again"):
        parts.read("x")
