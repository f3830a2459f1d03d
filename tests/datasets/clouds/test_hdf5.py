"""HDF5 files whose lists lead back to themselves: libhdf5 would fill the memory with them."""

import h5py
import numpy as np
import pytest

from qs3.datasets.clouds.hdf5 import check_heaps, open_hdf5, read_hdf5
from qs3.errors import DataError


def made(path, userblock=0):
    """A file in the old format whose group has had names that it has no more."""
    with h5py.File(path, "w", userblock_size=userblock) as file:
        file["data"] = np.zeros((3, 4, 3), dtype=np.float32)
        group = file.create_group("group")
        for name in ("a", "much longer than others", "c", "d"):
            group[name] = 1
        for name in ("a", "c"):
            del group[name]
    return path


def free_blocks(data, userblock):
    """Where the chains of free blocks lie: the place of each heap's first one's next."""
    found, at = [], data.find(b"HEAP")
    while at >= 0:
        _, first, segment = np.frombuffer(data[at + 8 : at + 32], dtype="<u8").tolist()
        if first != 1:
            found.append((first, segment + userblock + first))
        at = data.find(b"HEAP", at + 1)
    return found


def read(path):
    return read_hdf5(path, lambda shape, dtype: None)[0]


@pytest.mark.parametrize("userblock", [0, 512, 2048])
def test_a_circle_is_damage(tmp_path, userblock):
    path = made(tmp_path / "a.h5", userblock)
    check_heaps(path)
    assert read(path).shape == (3, 4, 3)
    data = path.read_bytes()
    blocks = free_blocks(data, userblock)
    assert len(blocks) == 2
    for first, at in blocks:
        damaged = bytearray(data)
        damaged[at : at + 8] = first.to_bytes(8, "little")
        path.write_bytes(damaged)
        for reads in (check_heaps, open_hdf5, read):
            with pytest.raises(DataError, match=r"a\.h5: the heap at byte \d+ is a circle"):
                reads(path)


def test_a_longer_circle(tmp_path):
    data = bytearray(made(tmp_path / "a.h5").read_bytes())
    first, at = free_blocks(data, 0)[0]
    heap = data.find(b"HEAP")
    size = int.from_bytes(data[heap + 8 : heap + 16], "little")
    chain = range(first, size - 15, 8)
    for here, after in zip(chain, [*chain[1:], first], strict=True):
        place = at + here - first
        data[place : place + 8] = after.to_bytes(8, "little")
    assert len(chain) > 1
    (tmp_path / "a.h5").write_bytes(data)
    with pytest.raises(DataError, match="is a circle"):
        check_heaps(tmp_path / "a.h5")


def test_numbers_of_three_bytes_are_refused(tmp_path):
    """HDF5 has them, numpy has not."""
    kind = h5py.h5t.STD_U32LE.copy()
    kind.set_size(3)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        h5py.h5d.create(file.id, b"data", kind, h5py.h5s.create_simple((5, 4, 3)))
    with pytest.raises(DataError, match=r"a\.h5: not a readable HDF5 file .*u3"):
        read(tmp_path / "a.h5")


@pytest.mark.parametrize("content", [b"", b"HEAP", b"\x89HDF", b"\x89HDF\r\n\x1a\n", bytes(5000)])
def test_what_is_no_hdf5_is_left_to_its_reader(tmp_path, content):
    (tmp_path / "a.h5").write_bytes(content)
    check_heaps(tmp_path / "a.h5")
    with pytest.raises(DataError, match=r"a\.h5: not a readable HDF5 file"):
        read(tmp_path / "a.h5")


@pytest.mark.parametrize("cut", range(0, 1500, 97))
def test_a_cut_file_ends_in_words(tmp_path, cut):
    data = made(tmp_path / "a.h5").read_bytes()
    (tmp_path / "a.h5").write_bytes(data[:cut])
    with pytest.raises(DataError):
        read(tmp_path / "a.h5")
