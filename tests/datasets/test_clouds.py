"""Files of clouds: every format and dialect, and what is not a cloud."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from pypcd4 import Encoding, PointCloud

from qs3.datasets.clouds import checked, parse_cloud, parse_clouds, with_depth
from qs3.errors import DataError
from tests.datasets.own_clouds import CLOUD, FORMATS, read_cloud, write


@pytest.mark.parametrize("suffix", [*FORMATS, ".XYZ", ".Ply"])
def test_every_format_gives_the_same_points(tmp_path: Path, suffix: str) -> None:
    found = read_cloud(write(tmp_path / f"a{suffix}"))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, CLOUD)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1,2,3\n4,5,6\n", [[1, 2, 3], [4, 5, 6]]),
        ("1, 2, 3;\n4, 5, 6;\n", [[1, 2, 3], [4, 5, 6]]),
        ("1.5;2.5; .5\n", [[1.5, 2.5, 0.5]]),
        ("-0.5,-1.0, 2.5\n", [[-0.5, -1, 2.5]]),
        ("0.5\t1.25 -2.75e1\n", [[0.5, 1.25, -27.5]]),
        ("x y z\r\n0.5 1.25 2.75\r\n", [[0.5, 1.25, 2.75]]),
        ("X,Y,Z,intensity\n0.5,1.25,2.75,3\n", [[0.5, 1.25, 2.75]]),
        ('\ufeff"x";"y";"z"\n0.5;1.25;2.75\n', [[0.5, 1.25, 2.75]]),
        ("# from a robot\n\nid x y z\n7 0.5 1.25 2.75\n", [[0.5, 1.25, 2.75]]),
        ("//R G B X Y Z\n7 8 9 0.5 1.25 2.75\n", [[0.5, 1.25, 2.75]]),
        ("# scanned today\n# z;y;x\n0.5;1.25;2.75\n", [[2.75, 1.25, 0.5]]),
        ("time,z,y,x,\n7,2.75,1.25,0.5\n", [[0.5, 1.25, 2.75]]),
        ("# x y z id\n0.5 1.25 2.75\n", [[0.5, 1.25, 2.75]]),
    ],
)
def test_dialects_of_text(text: str, expected: list, tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(parse_cloud(path), expected)


@pytest.mark.parametrize(
    "text",
    [
        "1,000.5 2,000.5 3,000.5\n",  # was read as 1, 0.5, 2
        "0,5;1,25;2,75\n",
        "1,5, 2,5, 3,5\n",
        "1.5,2,3 4\n",
        "1 2 3\n1,5 2,5 3,5\n",
        "1,2,3\n1,000.5 2,000.5 3,000.5\n",
        "x y\n1 2 3\n",
        "# t x y z\n1 2 3\n",
        "x y z x\n1 2 3 4\n",
        "x y z\n",
        "1 2 3\n4 5\n",
        "1 2\n",
        "",
    ],
)
def test_text_that_can_be_read_in_two_ways_or_none(text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(DataError, match=r"a\.txt"):
        parse_cloud(path)


@pytest.mark.parametrize("encoding", list(Encoding))
def test_pcd_of_every_encoding(tmp_path: Path, encoding: Encoding) -> None:
    """Organised, with further fields of other types, and pixels without a measurement."""
    xyz = np.random.default_rng(0).normal(size=(6, 3)).astype("f4")
    xyz[4] = np.nan
    fields, types = ("rgb", "x", "y", "z", "label"), (np.uint32, *[np.float32] * 3, np.uint8)
    other = np.arange(6)
    cloud = PointCloud.from_points([other, *xyz.T, other], fields, types)
    cloud.metadata.width, cloud.metadata.height = 3, 2
    cloud.save(tmp_path / "a.pcd", encoding)
    np.testing.assert_allclose(parse_cloud(tmp_path / "a.pcd"), xyz, rtol=1e-6)
    data = (tmp_path / "a.pcd").read_bytes()
    (tmp_path / "b.pcd").write_bytes(data.replace(b"FIELDS rgb x", b"FIELDS rgb w"))
    with pytest.raises(DataError, match=r"b\.pcd"):
        parse_cloud(tmp_path / "b.pcd")


@pytest.mark.parametrize("shape", [(480, 640), (60, 33), (9, 480, 640), (3, 11), (5, 3, 64), (4,)])
def test_pictures_and_turned_arrays_are_refused(shape: tuple, tmp_path: Path) -> None:
    array = np.random.default_rng(0).random(shape)
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", points=array)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data"] = array
    if len(shape) == 2:
        np.savetxt(tmp_path / "a.txt", array)
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(DataError, match=path.name):
            parse_clouds(path)


@pytest.mark.parametrize("shape", [(3, 3), (3, 9), (50, 32), (1, 3), (7, 3, 6)])
def test_few_points_and_many_columns_are_clouds(shape: tuple, tmp_path: Path) -> None:
    array = np.random.default_rng(0).random(shape)
    np.save(tmp_path / "a.npy", array)
    found = parse_clouds(tmp_path / "a.npy").clouds
    np.testing.assert_array_equal(np.stack(found), array.reshape(-1, *shape[-2:])[..., :3])


def test_files_of_several_clouds_and_their_labels(tmp_path: Path) -> None:
    many = np.stack([CLOUD, CLOUD + 1])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data"], file["label"] = many, np.array([1, 0])
    np.savez(tmp_path / "a.npz", points=many, cls=np.array(["bed", "été"]))
    for name, labels in (("a.h5", (1, 0)), ("a.npz", ("bed", "été"))):
        found = parse_clouds(tmp_path / name)
        assert (found.many, found.labels) == (True, labels)
        with pytest.raises(DataError, match=name):
            parse_cloud(tmp_path / name)
    np.savez(tmp_path / "b.npz", points=many, cls=np.array(["bed"]))
    with pytest.raises(DataError, match=r"b\.npz"):
        parse_clouds(tmp_path / "b.npz")


def test_points_without_a_measurement_are_left_out() -> None:
    cloud = np.array([[0, 0, 0], [1, 2, 3], [np.nan, 0, 1], [4, 5, np.inf]])
    kept, dropped = with_depth(cloud, "a")
    assert (kept.tolist(), dropped) == ([[0, 0, 0], [1, 2, 3]], 2)  # a single origin may be one
    kept, dropped = with_depth(np.concatenate([cloud, np.zeros((2, 3))]), "a")
    assert (kept.tolist(), dropped) == ([[1, 2, 3]], 5)
    for nothing in (np.zeros((3, 3)), np.full((2, 3), np.nan), np.zeros((0, 3))):
        with pytest.raises(DataError):
            with_depth(nothing, "a")


def test_far_from_the_origin_a_cloud_is_moved_before_float32_takes_its_digits() -> None:
    cloud = np.random.default_rng(0).random((50, 3))
    there = cloud + np.array([431_000.0, 5_400_000.0, 0])
    found = checked(there, "a")
    np.testing.assert_allclose(np.ptp(found, axis=0), np.ptp(cloud, axis=0), atol=1e-6)
    np.testing.assert_array_equal(found[:, 2], cloud[:, 2].astype("f4"))  # z is a height
    for lost in (there.astype("f4"), cloud + np.array([0, 0, 5_400_000.0])):
        with pytest.raises(DataError):
            checked(lost, "a")
    assert checked(cloud * 1000, "a").tolist() == (cloud * 1000).astype("f4").tolist()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39, 1e19])
def test_numbers_that_float32_cannot_measure_are_named(value: float) -> None:
    with pytest.raises(DataError, match="point 2"):
        checked(np.array([[1, 2, 3], [4, value, 6.0]]), "a")
    with pytest.raises(DataError):
        checked(np.zeros((0, 3)), "a")
