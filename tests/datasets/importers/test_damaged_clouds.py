"""Folders of own clouds: damage, pickles, points that are not finite."""

from __future__ import annotations

import os
import pickle
import re
from pathlib import Path

import h5py
import numpy as np
import pytest

from qs3.config.compose import composed
from qs3.config.hashing import config_hash
from qs3.datasets.importers import CloudFolder, import_into
from qs3.errors import DataError
from qs3.store.store import open_pointset, read_manifest
from tests.datasets.importers.own_clouds import (
    CLOUD,
    FORMATS,
    TWO,
    own,
    read_cloud,
    write,
    write_odd,
)


@pytest.mark.parametrize("suffix", FORMATS)
def test_truncated_files_never_give_other_points(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"a{suffix}")
    data = path.read_bytes()
    for size in range(0, len(data) - 1, max(1, len(data) // 60)):
        path.write_bytes(data[:size])
        found = complaint = None
        try:
            found = read_cloud(path)
        except DataError as error:
            complaint = str(error)
        if found is None:
            assert str(path) in str(complaint)
            continue
        # text may end after whole rows; and HDF5 and zip may be cut in their padding
        assert suffix in (".xyz", ".txt", ".h5"), (suffix, size)
        rows = len(found) - (suffix in (".xyz", ".txt"))  # a number may be cut in its digits
        np.testing.assert_array_equal(found[:rows], CLOUD[:rows])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.xyz", "1 2 3\n1 2\n", "line 2: '1 2' has 2 numbers, not 3"),
        ("a.xyz", "1 2\n", "line 1: '1 2' has 2 numbers, not 3"),
        ("a.txt", "1,2,3\na,b,c\n", "line 2: 'a b c' is not a row of numbers"),
        ("a.xyz", "1 2 3\n\n4 5 6 7\n", "line 3: '4 5 6 7' has 4 numbers, not 3"),
        ("a.xyz", "\xff\0", "line 1"),
        ("a.xyz", "\n\n", "there are no points"),
        ("a.xyz", "1 2 nan\n4 nan 6\n", r"a\.xyz: all 2 points are not finite"),
        ("a.xyz", "1 2 3\n4 1e39 6\n", r"point 2: .*not finite in float32; leave such"),
        ("a.xyz", "# only a comment\n", "there are no points"),
        ("a.xyz", "", "0 bytes"),
        ("a.pcd", "nonsense", r"a\.pcd"),
        ("a.stl", "solid", "unknown format; known are .xyz"),
    ],
)
def test_damaged_files_say_where(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(DataError, match=message):
        read_cloud(tmp_path / name)


class Trap:
    """Unpickling it would leave a trace."""

    def __reduce__(self):
        return (open, (os.environ["QS3_TRAP"], "w"))


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_pickles_are_refused_unopened(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("QS3_TRAP", str(tmp_path / "trap"))
    path, array = tmp_path / f"a{suffix}", np.array([Trap()], dtype=object)
    if suffix == ".npy":
        np.save(path, array, allow_pickle=True)
    else:
        np.savez(path, points=array)
    with pytest.raises(DataError, match=r"a\.np. ?.*(pickled array, refused|not a readable)"):
        read_cloud(path)
    path.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(DataError, match="not a readable"):
        read_cloud(path)
    assert not (tmp_path / "trap").exists()


def test_hdf5_may_not_point_elsewhere(tmp_path: Path) -> None:
    write(tmp_path / "there.h5")
    with h5py.File(tmp_path / "here.h5", "w") as file:
        file["data"] = h5py.ExternalLink("there.h5", "/data")
    with pytest.raises(DataError, match="is a link; refused"):
        read_cloud(tmp_path / "here.h5")


def test_damage_can_be_skipped_and_is_recorded(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path / "bed" / "a.xyz")
    (tmp_path / "bed" / "b.npz").write_bytes(b"PK")
    (tmp_path / "bed" / "c.xyz").write_text("1 2 inf\n")
    importer = CloudFolder(tmp_path, points=4, test_every=0, on_error="skip")
    clouds, rows = importer.read(TWO)
    assert len(clouds) == 1
    states = {"bed/train/a": "ok", "bed/train/b": "skipped", "bed/train/c": "skipped"}
    assert {r.id: r.status for r in rows} == states
    assert "has no clouds of chair" in caplog.text  # a warning
    with pytest.raises(DataError, match=r"b\.npz"):
        CloudFolder(tmp_path, points=4, test_every=0).read(TWO)


@pytest.mark.parametrize("suffix", FORMATS)
def test_points_that_are_not_finite_are_left_out(
    tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(0)
    cloud = rng.standard_normal((12, 3)).astype(np.float32)
    left = np.delete(cloud, [0, 5], axis=0)
    cloud[0], cloud[5, 1] = np.nan, np.inf
    write(tmp_path / "bed" / f"a{suffix}", cloud)
    with caplog.at_level("INFO"):
        (read,), (row,) = CloudFolder(tmp_path, points=10, test_every=0).read(("bed",))
    np.testing.assert_array_equal(read, left)
    assert row.valid_points == 10
    lost = r"(1 point that is|\d points that are) NaN, infinite or \(0, 0, 0\) left out"
    assert re.search(rf"a{suffix}\S*: {lost}", caplog.text)


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_a_wrong_label_can_be_skipped(tmp_path: Path, suffix: str) -> None:
    many, labels = np.stack([CLOUD, CLOUD + 1, CLOUD * np.nan, CLOUD]), np.array([1, 7, 0, 0])
    if suffix == ".npz":
        np.savez(tmp_path / "a.npz", points=many, label=labels)
    else:
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file["data"], file["label"] = many, labels
    with pytest.raises(DataError, match=r"cloud 1: label 7 is not 0\.\.1"):
        CloudFolder(tmp_path, points=4).read(TWO)
    store = tmp_path.with_name(f"{tmp_path.name}_store")
    importer = CloudFolder(tmp_path, points=4, on_error="skip")
    import_into(store, importer, name="mine", classes=TWO)
    data = open_pointset(store)
    assert data.ids == ("bed/train/a_0003", "chair/train/a_0000")
    assert "labelled" not in data.meta
    left_out = {r.origin: r.reason for r in read_manifest(store, TWO) if r.status == "skipped"}
    assert sorted(left_out) == [f"a{suffix}[1]", f"a{suffix}[2]"]
    assert "label 7" in left_out[f"a{suffix}[1]"]
    assert "not finite" in left_out[f"a{suffix}[2]"]


def test_damaged_files_are_named_and_the_others_go_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "in"
    write(folder / "a.xyz")
    write_odd(folder / "b.ply", folder / "c.h5", folder / "d.npz")
    data = own(tmp_path, layout="none", on_error="skip").open()
    assert data.ids == ("train/a",)
    for name in ("b.ply", "c.h5", "d.npz"):
        assert re.search(rf"left out: \S*{re.escape(name)}", caplog.text)
    assert "3 clouds left out" in caplog.text
    cfg = composed("train", "experiment=own_scans")
    assert cfg.data.target.published.on_error == "skip"
    stops = composed("train", "experiment=own_scans", "data.target.published.on_error=stop")
    assert config_hash(cfg) == config_hash(stops)  # data have hashes of their own


def test_where_all_files_are_damaged_the_reasons_are_said(tmp_path: Path) -> None:
    files = [write(tmp_path / f"{i}.npy", np.full((4, 3), np.nan)) for i in range(7)]
    with pytest.raises(DataError) as found:
        CloudFolder(tmp_path, points=4, on_error="skip").read(TWO)
    first, *reasons = str(found.value).splitlines()
    assert first == f"{tmp_path} holds no clouds that can be read; 7 are damaged:"
    assert reasons[0] == f"  {files[0]}: all 4 points are not finite (NaN or infinite)"
    assert reasons[5:] == ["  and 2 more"]


def test_a_file_of_one_cloud_is_called_as_it_is(tmp_path: Path) -> None:
    write(tmp_path / "one.npy")
    np.save(tmp_path / "several.npy", np.stack([CLOUD, 2 * CLOUD]))
    _, rows = CloudFolder(tmp_path, points=len(CLOUD)).read(TWO)
    assert [row.origin for row in rows] == ["one.npy", "several.npy[0]", "several.npy[1]"]


def test_a_store_without_damage_may_be_used_where_damage_is_left_out(tmp_path: Path) -> None:
    write(tmp_path / "in" / "bed" / "a.xyz")
    own(tmp_path, test_every=0).open()
    own(tmp_path, test_every=0, on_error="skip").open()
    with pytest.raises(DataError, match=r"was imported with .*; say published\.up=z to take it as"):
        own(tmp_path, test_every=0, up="x", on_error="skip").open()
