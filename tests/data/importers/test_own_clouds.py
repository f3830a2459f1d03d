"""Folders of one's own clouds: formats, layouts, damage, and sets without labels."""

from __future__ import annotations

import os
import pickle
import re
import struct
import tracemalloc
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from qs3.clouds.files import read_cloud, read_clouds
from qs3.config.compose import composed
from qs3.config.hashing import config_hash
from qs3.data.domain import Domain
from qs3.data.importers import CloudFolder, Importer, XyzTree, import_into
from qs3.data.store import open_pointset, read_manifest
from qs3.errors import ConfigError, DataError

TWO = ("bed", "chair")
CLOUD = np.arange(12, dtype=np.float64).reshape(4, 3) / 8  # exact in float32 and in text


def write(path: Path, cloud: np.ndarray = CLOUD) -> Path:
    """One cloud in the format of the path's extension."""
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = path.suffix.lower()
    if kind == ".xyz":
        np.savetxt(path, cloud)
    elif kind == ".txt":  # with normals, commas and a header
        lines = [",".join(map(str, [*row, 0, 0, 1])) for row in cloud.tolist()]
        path.write_text("\n".join(["# x,y,z,nx,ny,nz", *lines, "// the end"]) + "\n")
    elif kind == ".npy":
        np.save(path, cloud.astype("f4"))
    elif kind == ".npz":
        np.savez(path, points=cloud, colours=np.zeros((len(cloud), 3)))
    elif kind == ".ply":
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n"
        head += "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
        rows = b"".join(struct.pack("<fffB", *row, 7) for row in cloud.tolist())
        path.write_bytes((head + "end_header\n").encode() + rows)
    elif kind == ".pcd":  # an image of two rows, one pixel more without a measurement
        rows = [*cloud.tolist(), *[[np.nan] * 3] * (len(cloud) % 2 or 2)]
        head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        head += f"WIDTH {len(rows) // 2}\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\n"
        body = "\n".join(" ".join(map(str, row)) for row in rows)
        path.write_text(f"{head}POINTS {len(rows)}\nDATA ascii\n{body}\n")
    elif kind == ".h5":
        with h5py.File(path, "w") as file:
            file["data"] = cloud
    return path


FORMATS = (".xyz", ".txt", ".npy", ".npz", ".ply", ".pcd", ".h5")


@pytest.mark.parametrize("suffix", [*FORMATS, ".XYZ", ".Ply"])
def test_every_format_gives_the_same_points(tmp_path: Path, suffix: str) -> None:
    found = read_cloud(write(tmp_path / f"a{suffix}"))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, CLOUD)


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


def test_files_of_several_clouds(tmp_path: Path) -> None:
    many = np.stack([CLOUD, CLOUD + 1])
    with h5py.File(tmp_path / "train_0.h5", "w") as file:
        file["data"], file["label"] = many, np.array([1, 0])
    found = read_clouds(tmp_path / "train_0.h5")
    assert found.many
    assert found.labels == (1, 0)
    with pytest.raises(DataError, match="holds 2 clouds, expected one"):
        read_cloud(tmp_path / "train_0.h5")
    np.savez(tmp_path / "test_a.npz", points=many, cls=np.array(["bed", "chair"]))
    clouds, rows = CloudFolder(tmp_path, points=4).read(TWO)
    assert [(row.id, row.cls, row.split) for row in rows] == [
        ("bed/train/train_0_0001", "bed", "train"),
        ("chair/train/train_0_0000", "chair", "train"),
        ("bed/test/test_a_0000", "bed", "test"),
        ("chair/test/test_a_0001", "chair", "test"),
    ]
    assert [cloud[0, 0] for cloud in clouds] == [1, 0, 0, 1]


def test_layouts_are_recognised(tmp_path: Path) -> None:
    for name in ("a", "b"):
        for cls in TWO:
            for split in ("train", "test"):
                write(tmp_path / "one" / cls / split / f"{name}.xyz")
                write(tmp_path / "two" / split / cls / f"{name}.npy")
    expected = [f"{c}/{s}/{n}" for s in ("train", "test") for c in TWO for n in ("a", "b")]
    for root in ("one", "two"):
        _, rows = CloudFolder(tmp_path / root, points=4).read(TWO)
        assert [row.id for row in rows] == expected


def test_every_fifth_of_a_class_tests(tmp_path: Path) -> None:
    for i in range(7):
        write(tmp_path / "Chair" / f"c{i}.xyz", CLOUD + i)
        write(tmp_path / "bed" / f"b{i}.ply", CLOUD + i)
    clouds, rows = CloudFolder(tmp_path, points=4).read(TWO)
    assert [r.id for r in rows if r.split == "test"] == ["bed/test/b4", "chair/test/c4"]
    assert len(rows) == 14
    place = [row.id for row in rows].index("chair/test/c4")
    np.testing.assert_array_equal(clouds[place], (CLOUD + 4).astype("f4"))
    _, rows = CloudFolder(tmp_path, points=4, test_every=0).read(TWO)
    assert {row.split for row in rows} == {"train"}


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
    assert [row.cls for row in read_manifest(tmp_path / "store", TWO)] == ["", ""]
    assert data.counts() == {"train": {"bed": 0, "chair": 0}}
    assert data.split("train").ids == data.ids


def test_a_store_is_labelled_or_not(tmp_path: Path) -> None:
    write(tmp_path / "train" / "bed" / "a.xyz")
    write(tmp_path / "train" / "b.xyz")
    with pytest.raises(DataError, match=r"line 2|the same id|unknown class ''"):
        import_into(
            tmp_path / "store",
            CloudFolder(tmp_path, points=4, layout="split/class"),
            name="mixed",
            classes=TWO,
        )
    assert not (tmp_path / "store").exists()


def test_any_number_of_points(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rng = np.random.default_rng(0)
    large = rng.standard_normal((300, 3))
    write(tmp_path / "bed" / "large.xyz", large)
    write(tmp_path / "bed" / "small.xyz")
    clouds, rows = CloudFolder(tmp_path, points=16, test_every=0).read(("bed",))
    assert [row.valid_points for row in rows] == [300, 4]
    assert {cloud.shape for cloud in clouds} == {(16, 3)}
    assert (clouds[0][0] == large[0].astype("f4")).all()
    assert len(np.unique(clouds[0], axis=0)) == 16
    np.testing.assert_array_equal(clouds[1], np.tile(CLOUD, (4, 1)).astype("f4"))
    assert "1 clouds have under 16 points" in caplog.text


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_up_is_a_rotation_to_z(tmp_path: Path, up: str) -> None:
    importer = CloudFolder(tmp_path, up=up)
    turned = importer.turn(np.eye(3), "bed").T  # columns: where the axes go
    assert np.linalg.det(turned) == pytest.approx(1)
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1 if up.startswith("-") else 1
    np.testing.assert_array_equal(importer.turn(axis[None], "bed")[0], [0, 0, 1])


def test_wrong_folders_and_names(tmp_path: Path) -> None:
    write(tmp_path / "bed" / "a.xyz")
    write(tmp_path / "boat" / "a.xyz")
    with pytest.raises(DataError, match=r"boat is neither a class nor a split.*layout=none"):
        CloudFolder(tmp_path, points=4).read(TWO)
    write(tmp_path / "b" / "bed" / "a.xyz")
    write(tmp_path / "b" / "bed" / "a.ply")
    with pytest.raises(DataError, match=r"a\.(xyz|ply) and .*a\.(xyz|ply) have one name"):
        CloudFolder(tmp_path / "b", points=4).read(TWO)
    write(tmp_path / "c" / "bed" / "train" / "deep" / "a.xyz")
    with pytest.raises(DataError, match="does not lie in a folder class/split"):
        CloudFolder(tmp_path / "c", points=4).read(TWO)
    (tmp_path / "out.xyz").write_text("1 2 3\n")
    (tmp_path / "d" / "bed").mkdir(parents=True)
    (tmp_path / "d" / "bed" / "a.xyz").symlink_to(tmp_path / "out.xyz")
    with pytest.raises(DataError, match="link that leads out of"):
        CloudFolder(tmp_path / "d", points=4).read(TWO)
    (tmp_path / "e").mkdir()
    assert not CloudFolder(tmp_path / "e").is_there()


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


@pytest.mark.parametrize(
    "settings", [{"layout": "tree"}, {"up": "w"}, {"test_every": 1}, {"test_every": -1}]
)
def test_wrong_settings(tmp_path: Path, settings: dict) -> None:
    with pytest.raises(ConfigError):
        CloudFolder(tmp_path, **settings)


def test_linked_folders_are_refused(tmp_path: Path) -> None:
    """A link to a folder above would give every cloud some forty times."""
    write(tmp_path / "a.xyz")
    (tmp_path / "again").symlink_to(tmp_path)
    with pytest.raises(DataError, match="again is a link to a folder"):
        CloudFolder(tmp_path, points=4, layout="none").items(TWO)


def test_own_classes_are_found_as_they_are_written(tmp_path: Path) -> None:
    write(tmp_path / "Box" / "a.xyz")
    write(tmp_path / "coffee mug" / "a.xyz")
    _, rows = CloudFolder(tmp_path, points=4, test_every=0).read(("Box", "coffee-mug"))
    assert [row.cls for row in rows] == ["Box", "coffee-mug"]


def own(tmp_path: Path, **settings) -> Domain:
    """The domain of tmp_path/in."""
    published = CloudFolder(tmp_path / "in", points=4, **settings)
    return Domain("own", "O", "own clouds", tmp_path / "store", published=published, classes=TWO)


def test_changed_files_are_noticed(tmp_path: Path) -> None:
    for name in ("bed/a.xyz", "bed/b.npy", "chair/a.npz"):
        write(tmp_path / "in" / name)
    domain = own(tmp_path, test_every=0)
    before = domain.open().sha256
    (tmp_path / "in" / "notes.md").write_text("not a cloud")
    (tmp_path / "in" / ".hidden.xyz").write_text("1 2 3")
    assert domain.open().sha256 == before

    new = write(tmp_path / "in" / "chair" / "c.ply")
    with pytest.raises(DataError, match=r"1 added \(chair/c\.ply\); delete .*store to import"):
        domain.open()
    new.unlink()
    assert domain.open().sha256 == before

    (tmp_path / "in" / "bed" / "b.npy").rename(tmp_path / "in" / "bed" / "d.npy")
    with pytest.raises(DataError, match=r"1 added \(bed/d\.npy\), 1 removed \(bed/b\.npy\)"):
        domain.open()
    (tmp_path / "in" / "bed" / "d.npy").rename(tmp_path / "in" / "bed" / "b.npy")

    path = tmp_path / "in" / "bed" / "b.npy"
    changed = path.stat().st_mtime_ns + 1
    os.utime(path, ns=(changed, changed))
    with pytest.raises(DataError, match="some have changed; delete"):
        domain.open()
    (tmp_path / "in").rename(tmp_path / "away")  # put away after the import
    assert domain.open().sha256 == before


def test_files_that_change_during_the_import(tmp_path: Path) -> None:
    """Half of a folder that is still being copied must not become a store."""

    class Slow(CloudFolder):
        def thin(self, cloud: np.ndarray, where: str) -> np.ndarray:
            write(tmp_path / "in" / "b.xyz")
            return cloud

    write(tmp_path / "in" / "a.xyz")
    with pytest.raises(DataError, match="while they were imported; run the same command again"):
        import_into(tmp_path / "s", Slow(tmp_path / "in", points=4), name="s", classes=TWO)
    assert not (tmp_path / "s").exists()


def test_one_file_is_in_memory_at_a_time(tmp_path: Path) -> None:
    """Else a folder of large files would be in memory twice before the first cloud is thinned."""
    rng = np.random.default_rng(0)
    for i in range(8):
        many = rng.standard_normal((10, 5000, 3))  # 1.2 MB
        np.save(tmp_path / f"a{i}.npy", many)
        np.savez(tmp_path / f"b{i}.npz", points=many)
        with h5py.File(tmp_path / f"c{i}.h5", "w") as file:
            file["data"] = many
    importer = CloudFolder(tmp_path, points=4)
    importer.items(TWO[:1])  # modules are imported outside the measurement
    tracemalloc.start()
    try:
        items = importer.items(TWO[:1])
        total = sum(len(item.load()) for item in items)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert total == 3 * 8 * 10 * 5000
    assert peak < 4 << 20, "all files together have 29 MB"


def test_npy_is_not_read_to_be_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i in range(3):
        np.save(tmp_path / f"{i}.npy", np.stack([CLOUD, CLOUD + i]))
    monkeypatch.setattr(np, "load", lambda *a, **k: pytest.fail("read"))
    assert len(CloudFolder(tmp_path, points=4).items(TWO)) == 6


@pytest.mark.parametrize("importer", [CloudFolder, XyzTree])
def test_names_equal_but_for_case(tmp_path: Path, importer: type[Importer]) -> None:
    """Elsewhere one of them would overwrite the other."""
    write(tmp_path / "bed" / "train" / "a.xyz")
    write(tmp_path / "bed" / "train" / "A.XYZ")
    with pytest.raises(DataError, match=r"a\.xyz and .*A\.XYZ have one name"):
        importer(tmp_path, points=4).items(("bed",))


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
    assert re.search(rf"a{suffix}\S*: \d points that are NaN or infinite left out", caplog.text)


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
    header = "element vertex 1\nproperty list uchar float x\nproperty float y\nproperty float z\n"
    (folder / "b.ply").write_text(f"ply\nformat ascii 1.0\n{header}end_header\n1 1 2 3\n")
    with h5py.File(folder / "c.h5", "w") as file:
        file["data"] = h5py.Empty("f4")
    with zipfile.ZipFile(folder / "d.npz", "w") as file:
        file.writestr("points.txt", "1 2 3")
    data = own(tmp_path, layout="none", on_error="skip").open()
    assert data.ids == ("train/a",)
    for name in ("b.ply", "c.h5", "d.npz"):
        assert re.search(rf"left out: \S*{re.escape(name)}", caplog.text)
    assert "3 clouds left out" in caplog.text
    cfg = composed("train", "experiment=own_scans")
    assert cfg.data.target.published.on_error == "skip"
    stops = composed("train", "experiment=own_scans", "data.target.published.on_error=stop")
    assert config_hash(cfg) == config_hash(stops)  # data have hashes of their own


def test_a_store_without_damage_may_be_used_where_damage_is_left_out(tmp_path: Path) -> None:
    write(tmp_path / "in" / "bed" / "a.xyz")
    own(tmp_path, test_every=0).open()
    own(tmp_path, test_every=0, on_error="skip").open()
    with pytest.raises(DataError, match="was imported with"):
        own(tmp_path, test_every=0, up="x", on_error="skip").open()


def test_ids_of_splits_without_labels(tmp_path: Path) -> None:
    for name in ("train/a.xyz", "train/b.npy", "test/a.xyz"):
        write(tmp_path / name)
    np.save(tmp_path / "test" / "m.npy", np.stack([CLOUD, CLOUD]))
    _, rows = CloudFolder(tmp_path, points=4).read(TWO)
    ids = ["train/a", "train/b", "test/a", "test/m_0000", "test/m_0001"]
    assert [row.id for row in rows] == ids
    _, rows = CloudFolder(tmp_path, points=4, layout="none").read(TWO)  # the folders are names
    ids = ["test/a", "test/m_0000", "test/m_0001", "train/a", "train/b"]
    assert [row.id for row in rows] == [f"train/{id_}" for id_ in ids]


def test_other_settings_are_told_without_digests(tmp_path: Path) -> None:
    write(tmp_path / "in" / "bed" / "a.xyz")
    own(tmp_path, test_every=0).open()
    write(tmp_path / "in" / "bed" / "b.xyz")
    with pytest.raises(DataError, match=r"imported with \{'up': 'z'\}, the config says"):
        own(tmp_path, test_every=0, up="y").open()
