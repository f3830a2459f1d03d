"""MATLAB files whose tags lie, over which scipy ends the process, and files of 7.3."""

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from qs3.datasets.frames.matlab import load_v5, own_array
from qs3.errors import DataError

STRUCT = {"a": np.array([1.0, 2.0]), "b": "word", "c": {"d": np.eye(2, dtype=np.int16)}}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.mat"


def changed(path, before, after):
    """The file with one of its pieces replaced."""
    data = path.read_bytes()
    assert before in data
    path.write_bytes(data.replace(before, after, 1))


NUMBERS = b"\x09\0\0\0\x10\0\0\0"  # the tag of 16 bytes of float64
NAME = b"\x01\0\0\0\x09\0\0\0trainNdxs"
SIZE = b"\x05\0\0\0\x08\0\0\0\x01\0\0\0\x02\0\0\0"


@pytest.mark.parametrize(
    ("before", "after", "why"),
    [
        (NUMBERS, b"\x09\x01\0\0\x10\0\0\0", r"class 6 with parts of the types \[265\]"),
        (NUMBERS, b"\x0e\0\0\0\x10\0\0\0", r"parts of the types \[14\]"),
        (NUMBERS, b"\x09\0\0\0\x10\0\0\x70", "is cut off"),
        (NAME, b"\x09\0\0\0\x01IM\x0etrainNdxs", "is cut off"),
        (NAME, b"\x09\0\0\0\x09\0\0\0trainNdxs", "without kind, size and name"),
        (SIZE, SIZE[:8] + b"\xff\xff\xff\x7f\x02\0\0\0", r"an array of \[2147483647, 2\]"),
        (SIZE, SIZE[:8] + b"\xff\xff\xff\xff\x02\0\0\0", r"an array of \[-1, 2\]"),
        (b"\x00\x01IM", b"\x00\x03IM", "not that of version 5"),
        (b"MATLAB", b"\0ATLAB", "not that of version 5"),
    ],
)
def test_tags_that_lie_are_refused(path, before, after, why):
    savemat(path, {"trainNdxs": np.array([1.0, 2.0])})
    changed(path, before, after)
    with pytest.raises(DataError, match=rf"a\.mat is not a readable MATLAB file .*{why}"):
        load_v5(path)


@pytest.mark.parametrize("packed", [False, True])
def test_what_matlab_and_scipy_write_is_read(path, packed):
    cells = np.empty((1, 3), dtype=object)
    cells[0, :] = ["one", np.arange(3.0), ""]
    values = {"s": STRUCT, "cells": cells, "z": np.array([1 + 2j]), "none": np.zeros((0, 0)),
              "yes": np.array([True]), "i": np.arange(4, dtype=np.int8)}  # fmt: skip
    savemat(path, values, do_compression=packed)
    found = load_v5(path)
    assert found["s"]["b"] == "word"
    np.testing.assert_array_equal(found["s"]["c"]["d"], np.eye(2))
    assert found["cells"][0] == "one"
    assert found["z"] == 1 + 2j
    np.testing.assert_array_equal(found["i"], np.arange(4))


def test_a_bomb_is_refused_before_it_is_unpacked(path, monkeypatch):
    savemat(path, {"x": np.zeros(1_000_000)}, do_compression=True)
    assert path.stat().st_size < 200_000
    monkeypatch.setenv("QS3_MEMORY_GB", "0.005")
    with pytest.raises(DataError, match=r"a\.mat takes .* GB of memory, more than 0\.005 GB"):
        load_v5(path)


def test_names_that_are_no_text_can_be_listed(path):
    with h5py.File(path, "w") as file:
        file[b"\xff"], file["b"] = 1, 2
    with (
        h5py.File(path, "r") as file,
        pytest.raises(DataError, match=r"no variable 'a'; it has .*b"),
    ):
        own_array(file, "a", path)
