"""The zips of masks: what is read, and what is refused."""

import io
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.datasets.scannet.masks import INSTANCES, LABELS, MaskArchive
from qs3.errors import DataError
from tests.datasets.scannet.writing import png, write_zip


def images(dtype=np.uint8, count=3):
    rng = np.random.default_rng(1)
    top = np.iinfo(dtype).max
    return {i: rng.integers(0, top, (9, 12), endpoint=True, dtype=dtype) for i in range(count)}


@pytest.mark.parametrize(("dtype", "folder"), [(np.uint8, INSTANCES), (np.uint16, LABELS)])
def test_what_was_written_is_read(tmp_path, dtype, folder):
    made = images(dtype)
    write_zip(tmp_path / "a.zip", folder, made)
    with MaskArchive(tmp_path / "a.zip", folder) as masks:
        assert masks.frames == {0, 1, 2}
        for frame in (2, 0, 1):
            found = masks.read(frame)
            assert found.dtype == dtype
            np.testing.assert_array_equal(found, made[frame])
        with pytest.raises(DataError, match="frame 7: there is no mask"):
            masks.read(7)


def test_a_folder_about_the_folder_and_other_files_do_no_harm(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        file.writestr(f"scene0000_00/{INSTANCES}/12.png", png(images()[0]))
        file.writestr("readme.txt", "hello")
        for name in (f"{INSTANCES}/notes.txt", f"../{INSTANCES}/0.png", f"/{INSTANCES}/0.png"):
            file.writestr(name, "hello")
    with MaskArchive(tmp_path / "a.zip", INSTANCES) as masks:
        assert masks.frames == {12}


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_masks_of_a_frame_or_none_at_all_are_told(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        for _ in range(2):
            file.writestr(f"{INSTANCES}/3.png", png(images()[0]))
    with pytest.raises(DataError, match="two masks of frame 3"):
        MaskArchive(tmp_path / "a.zip", INSTANCES)
    with pytest.raises(DataError, match="holds no label-filt/<frame>"):
        MaskArchive(tmp_path / "a.zip", LABELS)


@pytest.mark.parametrize("method", [12, 14, 99])
def test_a_member_that_claims_to_be_packed_otherwise_is_refused(tmp_path, method):
    """bzip2, LZMA, or nothing that zips know."""
    path = tmp_path / "a.zip"
    write_zip(path, INSTANCES, images())
    data = bytearray(path.read_bytes())
    for mark, place in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        at = data.find(mark)
        while at >= 0:
            data[at + place] = method
            at = data.find(mark, at + 1)
    path.write_bytes(data)
    with MaskArchive(path, INSTANCES) as masks, pytest.raises(DataError, match="unpacked"):
        masks.read(min(masks.frames))


def test_a_zip_cannot_unpack_without_end(tmp_path):
    """A member of 200 MB in a small file: no more than the limit is ever unpacked."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(f"{INSTANCES}/0.png", bytes(200_000_000))
    assert (tmp_path / "a.zip").stat().st_size < 300_000
    with (
        MaskArchive(tmp_path / "a.zip", INSTANCES) as masks,
        pytest.raises(DataError, match="frame 0: the PNG has more than"),
    ):
        masks.read(0)


@settings(max_examples=150, deadline=None)
@given(
    changes=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=8),
    cut=st.integers(0, 3000),
)
def test_a_garbled_zip_is_read_or_refused_and_nothing_else(tmp_path_factory, changes, cut):
    path = tmp_path_factory.mktemp("garbled") / "a.zip"
    write_zip(path, INSTANCES, images())
    data = bytearray(path.read_bytes())
    for at, value in changes:
        data[at % len(data)] = value
    path.write_bytes(data[:-cut] if cut % 3 == 0 and cut else data)
    told = None
    try:
        with MaskArchive(path, INSTANCES) as masks:
            dtypes = {masks.read(frame).dtype for frame in masks.frames}
            assert dtypes <= {np.dtype(np.uint8), np.dtype(np.uint16)}
    except DataError as error:
        told = str(error)
    assert told is None or "a.zip" in told


def test_a_name_of_nothing_is_told(tmp_path):
    file = tmp_path / "masks.zip"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("xnstance-filt/0.png", b"")
    file.write_bytes(file.read_bytes().replace(b"xnstance", b"\0nstance"))
    with pytest.raises(DataError, match=r"masks\.zip"):
        MaskArchive(file, INSTANCES)


def test_an_encrypted_mask_is_told(tmp_path):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as made:
        made.writestr(f"{INSTANCES}/0.png", png(images()[0]))
    data = bytearray(file.getvalue())
    at = data.index(b"PK\x01\x02")
    data[at + 8] |= 1
    (tmp_path / "a.zip").write_bytes(data)
    with (
        MaskArchive(tmp_path / "a.zip", INSTANCES) as masks,
        pytest.raises(DataError, match=r"frame 0 cannot be unpacked .*encrypted"),
    ):
        masks.read(0)
