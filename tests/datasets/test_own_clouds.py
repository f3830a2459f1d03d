"""Folders of one's own clouds: formats, layouts, and sets without labels."""

from __future__ import annotations

import os
from pathlib import Path

import h5py
import numpy as np
import pytest

from qs3.datasets.clouds import CloudFolder
from qs3.datasets.importing import import_into
from qs3.errors import DataError
from qs3.store.meta import read_manifest
from qs3.store.store import open_pointset
from tests.datasets.own_clouds import CLOUD, TWO, own, write


def test_layouts_are_recognised(tmp_path: Path) -> None:
    for name in ("a", "b"):
        for cls in TWO:
            for split in ("train", "test"):
                write(tmp_path / "one" / cls / split / f"{name}.xyz")
                write(tmp_path / "two" / split / cls / f"{name}.npy")
    expected = [f"{c}/{s}/{n}" for s in ("train", "test") for c in TWO for n in ("a", "b")]
    for root in ("one", "two"):
        _, rows = CloudFolder(tmp_path / root, points=4).read(TWO, tmp_path)
        assert [row.id for row in rows] == expected


def test_without_labels(tmp_path: Path) -> None:
    write(tmp_path / "in" / "b.pcd")
    write(tmp_path / "in" / "deep" / "a.xyz", CLOUD + 1)
    importer = CloudFolder(tmp_path / "in", points=4, layout="none")
    import_into(tmp_path / "store", importer, name="mine", classes=TWO)
    data = open_pointset(tmp_path / "store")
    assert not data.labelled
    assert data.labels.tolist() == [-1, -1]
    assert data.meta["labelled"] is False
    assert data.ids == ("train/b", "train/deep/a")
    assert data.splits.tolist() == ["train", "train"]
    assert [row.cls for row in read_manifest(tmp_path / "store")] == ["", ""]
    assert data.counts() == {"train": {"bed": 0, "chair": 0}}
    assert data.split("train").ids == data.ids


def test_the_folder_says_the_split_and_a_name_where_no_folder_does(tmp_path: Path) -> None:
    """`test/train_station.npy` must not train."""
    several = np.stack([CLOUD, CLOUD + 1])
    for place in ("in/test/train_station", "in/train/test_hall", "flat/test_hall", "flat/hall"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        np.save(tmp_path / f"{place}.npy", several)
    _, rows = CloudFolder(tmp_path / "in", points=4).read(TWO, tmp_path)
    assert [(row.split, row.origin) for row in rows] == [
        *(("train", f"train/test_hall.npy[{i}]") for i in range(2)),
        *(("test", f"test/train_station.npy[{i}]") for i in range(2)),
    ]
    _, rows = CloudFolder(tmp_path / "flat", points=4).read(TWO, tmp_path)
    assert [(row.split, row.origin) for row in rows] == [
        *(("train", f"hall.npy[{i}]") for i in range(2)),
        *(("test", f"test_hall.npy[{i}]") for i in range(2)),
    ]


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_up_is_a_rotation_to_z(tmp_path: Path, up: str) -> None:
    importer = CloudFolder(tmp_path, up=up)
    turned = importer.turn(np.eye(3), "bed").T  # columns: where the axes go
    assert np.linalg.det(turned) == pytest.approx(1)
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1 if up.startswith("-") else 1
    np.testing.assert_array_equal(importer.turn(axis[None], "bed")[0], [0, 0, 1])


def test_every_fifth_of_a_class_is_for_test(tmp_path: Path) -> None:
    for cls in TWO:
        for i in range(7):
            write(tmp_path / cls / f"{i}.xyz")
    for every, expected in ((5, ["bed/test/4", "chair/test/4"]), (0, [])):
        _, rows = CloudFolder(tmp_path, points=4, test_every=every).read(TWO, tmp_path)
        assert [row.id for row in rows if row.split == "test"] == expected
        assert len(rows) == 14


def test_wrong_folders_and_names(tmp_path: Path) -> None:
    for place, word in (
        ("a/boat/a", "boat"),
        ("c/bed/train/chair/a", "chair"),
        ("d/bed/dev/a", "dev"),
    ):
        write(tmp_path / f"{place}.xyz")
        with pytest.raises(DataError, match=word):
            CloudFolder(tmp_path / place[0], points=4).read(TWO, tmp_path)
    write(tmp_path / "in" / "bed" / "a.xyz")
    write(tmp_path / "in" / "bed" / "a.ply")
    with pytest.raises(DataError, match="bed/train/a"):  # one name twice
        own(tmp_path).open()
    (tmp_path / "e").mkdir()
    assert not CloudFolder(tmp_path / "e").is_there()


def test_files_of_several_clouds(tmp_path: Path) -> None:
    many = np.stack([CLOUD, CLOUD + 1])
    with h5py.File(tmp_path / "train_0.h5", "w") as file:
        file["data"], file["label"] = many, np.array([1, 0])
    np.savez(tmp_path / "test_a.npz", points=many, cls=np.array(["bed", "chair"]))
    clouds, rows = CloudFolder(tmp_path, points=4).read(TWO, tmp_path)
    assert [row.id for row in rows] == [
        "bed/train/train_0_0001", "chair/train/train_0_0000",
        "bed/test/test_a_0000", "chair/test/test_a_0001",
    ]  # fmt: skip
    assert [cloud[0, 0] for cloud in clouds] == [1, 0, 0, 1]


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_damage_can_be_skipped_and_is_recorded(tmp_path: Path, suffix: str) -> None:
    """A damaged file, and a cloud without points; a label of no class is an error always."""
    many, labels = np.stack([CLOUD, CLOUD * np.nan, CLOUD]), np.array([1, 0, 0])
    folder = tmp_path / "in"
    folder.mkdir()
    if suffix == ".npz":
        np.savez(folder / "a.npz", points=many, label=labels)
    else:
        with h5py.File(folder / "a.h5", "w") as file:
            file["data"], file["label"] = many, labels
    (folder / "b.npz").write_bytes(b"PK")
    with pytest.raises(DataError, match=r"a\.|b\.npz"):
        own(tmp_path).open()
    data = own(tmp_path, on_error="skip").open()
    assert data.ids == ("bed/train/a_0002", "chair/train/a_0000")
    rows = read_manifest(tmp_path / "store")
    left_out = {row.origin for row in rows if row.status == "skipped"}
    assert left_out == {f"a{suffix}[1]", "b.npz"}
    own(tmp_path, on_error="skip").open()
    np.savez(folder / "c.npz", points=many[:1], label=np.array([7]))
    with pytest.raises(DataError, match=r"c\.npz"):
        own(tmp_path, on_error="skip").importer().items(TWO)


def test_changed_files_are_noticed(tmp_path: Path) -> None:
    for name in ("bed/a.xyz", "bed/b.npy", "chair/a.npz"):
        write(tmp_path / "in" / name)
    domain = own(tmp_path, test_every=0)
    before = domain.open().sha256
    (tmp_path / "in" / "notes.md").write_text("not a cloud")
    (tmp_path / "in" / ".hidden.xyz").write_text("1 2 3")
    assert domain.open().sha256 == before

    new = write(tmp_path / "in" / "chair" / "c.ply")
    with pytest.raises(DataError):
        domain.open()
    new.unlink()
    assert domain.open().sha256 == before
    path = tmp_path / "in" / "bed" / "b.npy"
    changed = path.stat().st_mtime_ns + 1
    os.utime(path, ns=(changed, changed))
    with pytest.raises(DataError):
        domain.open()
    (tmp_path / "in").rename(tmp_path / "away")  # put away after the import
    assert domain.open().sha256 == before


def test_files_that_change_during_the_import(tmp_path: Path) -> None:
    """Half of a folder that is still being copied must not become a store."""

    class Slow(CloudFolder):
        def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
            write(tmp_path / "in" / "b.xyz")
            return cloud

    write(tmp_path / "in" / "a.xyz")
    with pytest.raises(DataError):
        import_into(tmp_path / "s", Slow(tmp_path / "in", points=4), name="s", classes=TWO)
    assert not (tmp_path / "s").exists()
