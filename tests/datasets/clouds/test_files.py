"""Damaged and hostile files of clouds: a DataError in bounded memory, never anything else."""

from __future__ import annotations

import io
import re
import struct
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from qs3.datasets.clouds.files import SUFFIXES, npy_clouds, parse_cloud, parse_clouds
from qs3.errors import ConfigError, DataError
from tests.limits import memory_of_at_most, time_of_at_most

CLOUD = np.random.default_rng(0).normal(size=(20, 3))
HALF_GB = 1 << 29


def npy_header(shape: str, descr: str = "'<f4'") -> bytes:
    words = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(words)) + words


def npz(path: Path, **members: bytes) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)


def hdf5(path: Path, fill: str) -> None:
    """A kilobyte or two that says that it holds a lot, or nothing."""
    few = CLOUD[None].repeat(2, axis=0)
    with h5py.File(path, "w") as file:
        if fill == "empty":
            file["data"] = h5py.Empty("f4")
        elif fill == "data":
            file.create_dataset("data", (700, 100_000, 3), "f8", chunks=(1, 1000, 3))
        elif fill == "label":
            file["data"] = few
            file.create_dataset("label", (700_000_000,), "i4", chunks=(1000,))
        elif fill == "long label":
            file["data"] = few
            file.create_dataset("label", (2,), "S1500000000", chunks=(1,))
        elif fill == "no label":
            file["data"] = few
            file["label"] = h5py.Empty("i4")
        else:
            file["data"] = np.zeros((5000, 1, 3))
            words = file.create_dataset("label", (5000,), h5py.string_dtype(), chunks=(5000,))
            words[0] = "a" * 3_000_000
            words.id.flush()


def write_ply(path: Path, fill: str) -> None:
    kind = "list uchar float x" if fill == "list" else "float x"
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 2\nproperty {kind}\nproperty float y\n"
        "property float z\nend_header\n" + "1 1 2 3\n" * 2
    )


def text_pcd(path: Path, fill: str) -> None:
    count = 12_000_000
    path.write_bytes(
        b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH %d\nHEIGHT 1\n"
        b"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS %d\nDATA ascii\n" % (count, count) + b"1 2 3\n" * count
    )


def packed_pcd(path: Path, fill: str) -> None:
    """LZF stands for at most 88 times as many bytes."""
    count = 60_000_000
    path.write_bytes(
        b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH %d\nHEIGHT 1\n"
        b"POINTS %d\nDATA binary_compressed\n"
        % (count, count)
        + np.array([9_000_000, 12 * count], "<u4").tobytes()
        + bytes(9_000_000)
    )


HOSTILE = {
    "list.ply": (write_ply, "vertices with lists of x"),
    "empty.h5": (hdf5, "is empty"),
    "no label.h5": (hdf5, "labels is empty"),
    "data.h5": (hdf5, "takes 3.36 GB"),
    "label.h5": (hdf5, "GB of memory"),
    "long label.h5": (hdf5, "takes 3 GB"),
    "text.pcd": (text_pcd, "takes 2.69 GB"),
    "packed.pcd": (packed_pcd, "takes 2.16 GB"),
    "no npy.npz": (
        lambda path, _: zipfile.ZipFile(path, "w").writestr("points.txt", b"1 2 3"),
        "not a readable .npz",
    ),
    "promise.npz": (
        lambda path, _: npz(path, points=npy_header("(1000000000, 3)") + bytes(120)),
        "expected 12000000",
    ),
    "label.npz": (
        lambda path, _: npz(
            path, points=npy_header("(10, 3)") + bytes(120), label=npy_header("(900000000,)")
        ),
        "label: .* bytes, expected",
    ),
    "object.npz": (
        lambda path, _: np.savez(path, points=np.array([{}], dtype=object)),
        "a pickled array, refused",
    ),
    "deep.npy": (
        lambda path, _: path.write_bytes(npy_header("(" * 4000 + "3,)")),
        "not a readable .npy",
    ),
    "overflow.npy": (
        lambda path, _: path.write_bytes(npy_header(f"({2**32}, {2**32}, 3)")),
        "expected 221360928884514619",
    ),
    "odd.npy": (lambda path, _: path.write_bytes(npy_header("{}")), "not a readable .npy"),
    "nul.npz": (
        lambda path, _: path.write_bytes(_npz_with_nul()),
        "not a readable .npz",
    ),
}


def _npz_with_nul() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("xpoints.npy", b"")
    return file.getvalue().replace(b"xpoints", b"\0points")


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_refused_in_bounded_memory_and_time(name, tmp_path):
    write, message = HOSTILE[name]
    path = tmp_path / name
    write(path, path.stem)
    limits = memory_of_at_most(HALF_GB), time_of_at_most(20)
    with limits[0], limits[1], pytest.raises(DataError, match=message) as told:
        parse_clouds(path)
    assert str(told.value).startswith(str(path))
    assert len(str(told.value)) < 500


def test_what_a_file_unpacks_to_is_counted(tmp_path, monkeypatch):
    npz(tmp_path / "bomb.npz", points=bytes(6_000_000))
    assert (tmp_path / "bomb.npz").stat().st_size < 10_000
    monkeypatch.setenv("QS3_MEMORY_GB", "0.01")
    with pytest.raises(DataError, match=r"bomb\.npz takes 0\.012 GB"):
        parse_clouds(tmp_path / "bomb.npz")


def test_one_word_at_many_places_is_counted_each_time(tmp_path, monkeypatch):
    path = tmp_path / "shared.h5"
    hdf5(path, "shared")
    data = path.read_bytes()
    with h5py.File(path) as file:
        place = file["label"].id.get_chunk_info(0).byte_offset
    path.write_bytes(data[:place] + data[place : place + 16] * 5000 + data[place + 80_000 :])
    monkeypatch.setenv("QS3_MEMORY_GB", "0.05")
    with pytest.raises(DataError, match="GB of memory"):
        parse_clouds(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_large_file_is_not_even_read(suffix, tmp_path):
    path = tmp_path / f"large{suffix}"
    with open(path, "wb") as file:
        file.truncate(1_500_000_000)
    with memory_of_at_most(HALF_GB), pytest.raises(DataError, match=r"large.* takes 3 GB.*GB=3"):
        parse_clouds(path)


def test_the_limit_is_a_setting(tmp_path, monkeypatch):
    np.save(tmp_path / "a.npy", CLOUD)
    monkeypatch.setenv("QS3_MEMORY_GB", "1e-6")
    with pytest.raises(DataError, match=r"a\.npy takes 1.22e-06 GB of memory, more than 1e-06 GB"):
        parse_clouds(tmp_path / "a.npy")
    monkeypatch.setenv("QS3_MEMORY_GB", "much")
    with pytest.raises(ConfigError, match="QS3_MEMORY_GB=much: expected gigabytes"):
        parse_clouds(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0,5;1,25;2,75\n1;2;3,5\n", [[0.5, 1.25, 2.75], [1, 2, 3.5]]),
        ("# 1,5 m\n0,5\t1,25 -2,75e1\n", [[0.5, 1.25, -27.5]]),
        ("1;2;3\n1,5;2;3\n", [[1, 2, 3], [1.5, 2, 3]]),
        ("1,2,3\n4,5,6\n", [[1, 2, 3], [4, 5, 6]]),
        ("1, 2, 3;\n4, 5, 6;\n", [[1, 2, 3], [4, 5, 6]]),
        ("1.5,2,3 4\n", [[1.5, 2, 3]]),
        ("1.5;2,5;.5\n", [[1.5, 2.5, 0.5]]),
    ],
)
def test_decimal_commas(text, expected, tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(text)
    np.testing.assert_array_equal(parse_cloud(path), expected)


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("x y z", "0.5 1.25 2.75"),
        ("X,Y,Z,intensity", "0.5,1.25,2.75,3"),
        ('\ufeff"x";"y";"z"', "0,5;1,25;2,75"),
        ("# from a robot\n\nx y z", "0,5 1,25 2,75"),
        ("\ufeff# x y z", "0.5 1.25 2.75"),
    ],
)
def test_a_row_of_names_is_passed_over(head, row, tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(f"{head}\r\n{row}\r\n{row}\r\n", encoding="utf-8")
    np.testing.assert_array_equal(parse_cloud(path), [[0.5, 1.25, 2.75]] * 2)


@pytest.mark.parametrize(
    ("head", "row", "expected"),
    [
        ("id x y z", "7 0.5 1.25 2.75", [0.5, 1.25, 2.75]),
        ("# id x y z", "7 0.5 1.25 2.75", [0.5, 1.25, 2.75]),
        ("//R G B X Y Z", "7 8 9 0.5 1.25 2.75", [0.5, 1.25, 2.75]),
        ("# scanned today\n# z;y;x", "0,5;1,25;2,75", [2.75, 1.25, 0.5]),
        ("time,z,y,x,", "7,2.75,1.25,0.5", [0.5, 1.25, 2.75]),
        ("# offset x y z", "7 0.5 1.25 2.75", [7, 0.5, 1.25]),  # may be of anything
        ("# x y z id", "0.5 1.25 2.75", [0.5, 1.25, 2.75]),
    ],
)
def test_columns_go_by_their_names(head, row, expected, tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(f"{head}\n{row}\n{row}\n")
    np.testing.assert_array_equal(parse_cloud(path), [expected] * 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x y\n1 2 3\n", "line 1: 'x y' is not a row of numbers"),
        ("# t x y z\n1 2 3\n", r"names 4 columns"),
        (
            "t x y z\n1 2 3\n",
            r"4 columns \(t x y z\), the others have 3: which are x, y and z",
        ),
        ("x y z x\n1 2 3 4\n", "line 1: 'x y z x' is not a row of numbers"),
        ("x y z\nx y z\n1 2 3\n", "line 2: 'x y z' is not a row of numbers"),
        ("x y z\n", "there are no points"),
    ],
)
def test_other_words_are_not(text, message, tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        parse_cloud(path)


@pytest.mark.parametrize("letter", [0x110000, 0xFFFFFFFF, 0xD800])
@pytest.mark.parametrize("order", "<>")
def test_letters_that_do_not_exist_are_refused(letter, order, tmp_path):
    words = np.array([0x61, letter], dtype=f"{order}u4").view(f"{order}U1")
    np.savez(tmp_path / "a.npz", points=np.ones((2, 4, 3)), label=words)
    with pytest.raises(DataError, match=r"a\.npz, label: its words hold letters that do not exist"):
        parse_clouds(tmp_path / "a.npz")
    np.save(tmp_path / "b.npy", words)
    with pytest.raises(DataError, match=r"b\.npy: its words hold letters"):
        parse_clouds(tmp_path / "b.npy")
    np.savez(tmp_path / "c.npz", points=np.ones((2, 4, 3)), label=np.array(["chaise", "été"]))
    assert parse_clouds(tmp_path / "c.npz").labels == ("chaise", "été")


@pytest.mark.parametrize("columns", [3, 6])
def test_one_organised_cloud_is_not_taken_for_as_many_as_it_has_rows(columns, tmp_path):
    image = np.zeros((240, 320, columns), np.float32)
    np.save(tmp_path / "a.npy", image)
    with pytest.raises(DataError, match=rf"320 x 240 px.*save cloud\.reshape\(-1, {columns}\)"):
        parse_clouds(tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", image.reshape(-1, columns))
    assert len(parse_clouds(tmp_path / "a.npy").clouds) == 1
    np.save(tmp_path / "a.npy", image[:239])
    assert len(parse_clouds(tmp_path / "a.npy").clouds) == 239


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        (
            (480, 640),
            "looks like a depth image, 640 x 480 px: give it as depth= with mask= or box=",
        ),
        ((60, 33), "looks like a depth image"),
        ((9, 480, 640), "looks like a depth image"),
        ((3, 11), "is it transposed? A point is a row x y z: save array.T"),
        ((3, 2048), "is it transposed?"),
        ((6, 2048), "is it transposed?"),
        ((5, 3, 64), "save array.transpose(0, 2, 1)"),
    ],
)
def test_arrays_that_are_no_clouds_are_refused(shape, said, tmp_path):
    array = np.random.default_rng(0).random(shape)
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", points=array)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data"] = array
    files = ["a.npy", "a.npz", "a.h5"]
    if len(shape) == 2:
        np.savetxt(tmp_path / "a.txt", array)
        files.append("a.txt")
    for name in files:
        with pytest.raises(DataError, match=re.escape(said)) as told:
            parse_clouds(tmp_path / name)
        assert str(told.value).startswith(str(tmp_path / name))


@pytest.mark.parametrize("shape", [(3, 3), (3, 6), (3, 9), (4, 10), (50, 32), (1, 3), (7, 3, 6)])
def test_few_points_and_many_columns_are_clouds(shape, tmp_path):
    array = np.random.default_rng(0).random(shape)
    np.save(tmp_path / "a.npy", array)
    found = parse_clouds(tmp_path / "a.npy").clouds
    np.testing.assert_array_equal(np.stack(found), array.reshape(-1, *shape[-2:])[..., :3])


def records(cloud: np.ndarray, names: str = "xyz", kind: str = "f4") -> np.ndarray:
    """[..., 3] as records, a colour before the coordinates and after z."""
    fields = [("rgb", "u4"), *((name, kind) for name in reversed(names)), ("ring", "u2")]
    found = np.zeros(cloud.shape[:-1], dtype=fields)
    for axis, name in enumerate(names):
        found[name] = cloud[..., axis]
    return found


@pytest.mark.parametrize("names", ["xyz", "XYZ"])
def test_records_go_by_the_names_of_their_fields(tmp_path: Path, names: str) -> None:
    cloud = CLOUD.astype(np.float32)
    np.save(tmp_path / "a.npy", records(cloud, names))
    np.savez(tmp_path / "a.npz", points=records(cloud, names))
    for name in ("a.npy", "a.npz"):
        found = parse_cloud(tmp_path / name)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, cloud)
    assert npy_clouds(tmp_path / "a.npy") is None
    many = np.stack([cloud, cloud + 1])
    np.save(tmp_path / "many.npy", records(many, names))
    assert npy_clouds(tmp_path / "many.npy") == 2
    np.testing.assert_array_equal(parse_clouds(tmp_path / "many.npy").clouds, many)


@pytest.mark.parametrize(
    ("array", "why"),
    [
        (records(CLOUD, "xyw"), "records of rgb, w, y, x, ring: which are numbers x, y and z"),
        (records(CLOUD, "xyz", "S4"), "which are numbers"),
        (records(np.zeros((20, 4)), "xyzX"), "which are numbers"),
        (records(np.zeros((480, 640, 3))), "organised cloud"),
        (np.zeros(20, dtype=[("x", "f4", 3), ("y", "f4"), ("z", "f4")]), "which are numbers"),
        (np.zeros((), dtype=[(axis, "f4") for axis in "xyz"]), r"shape \(3,\), expected"),
    ],
)
def test_records_that_are_no_cloud(tmp_path: Path, array: np.ndarray, why: str) -> None:
    np.save(tmp_path / "a.npy", array)
    for read in (parse_clouds, npy_clouds):
        with pytest.raises(DataError, match=why):
            read(tmp_path / "a.npy")
