"""Published formats: known answers, then every kind of damage we could think of."""

import os
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest

from qs3.datasets.clouds.files import parse_cloud
from qs3.datasets.importers import NamedArrays, NpyTree, PointDAH5, XyzTree, import_into
from qs3.datasets.importers.base import check_cloud
from qs3.errors import ConfigError, DataError
from qs3.store.store import open_pointset
from tests.datasets.importers.test_damaged_clouds import Trap

TWO = ("bed", "chair")


def xyz_tree(root, names=("a", "b"), classes=TWO, splits=("train", "test"), rows=4):
    for c, cls in enumerate(classes):
        for s, split in enumerate(splits):
            (root / cls / split).mkdir(parents=True, exist_ok=True)
            for n, name in enumerate(names):
                cloud = 100 * c + 10 * s + n + np.arange(rows * 3).reshape(-1, 3)
                np.savetxt(root / cls / split / f"{name}.xyz", cloud)
    return root


def test_order_ids_and_coordinates(tmp_path):
    importer = XyzTree(xyz_tree(tmp_path), points=4)
    assert importer.is_there()
    clouds, rows = importer.read(TWO)
    assert [row.id for row in rows] == [
        "bed/train/a", "bed/train/b", "chair/train/a", "chair/train/b",
        "bed/test/a", "bed/test/b", "chair/test/a", "chair/test/b",
    ]  # fmt: skip
    assert [cloud[0, 0] for cloud in clouds] == [0, 1, 100, 101, 10, 11, 110, 111]
    assert clouds[0].tolist() == np.arange(12).reshape(4, 3).tolist()
    assert clouds[0].dtype == np.float32
    assert rows[0].origin == os.path.join("bed", "train", "a.xyz")
    assert {row.valid_points for row in rows} == {4}


def test_few_points_are_repeated_and_counted(tmp_path, caplog):
    clouds, rows = XyzTree(xyz_tree(tmp_path), points=10).read(TWO)
    np.testing.assert_array_equal(clouds[0], np.resize(np.arange(12), (10, 3)))
    assert {row.valid_points for row in rows} == {4}
    assert "8 clouds have under 10 points" in caplog.text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"1 2 3\n4 5\n", r"line 2: '4 5' has 2 numbers, not 3"),
        (b"1 2 3\n4 nan 6\n", r"point 2: \[4.0, nan, 6.0\] is not finite"),
        (b"1 2 3\n4 1e39 6\n", "point 2: .*inf.* is not finite"),
        (b"1 2 3\n" * 5, "the cloud has 5 points, expected 1 to 4"),
    ],
)
def test_clouds_that_were_not_published_so(tmp_path, text, message):
    xyz_tree(tmp_path)
    (tmp_path / "chair" / "test" / "b.xyz").write_bytes(text)
    with pytest.raises(DataError, match=r"chair.test.b\.xyz.*(" + message + ")"):
        XyzTree(tmp_path, points=4).read(TWO)


def test_names_of_classes_and_splits(tmp_path):
    xyz_tree(tmp_path, classes=("Night_Stand", "COUCH"), splits=("train", "val"))
    _, rows = XyzTree(tmp_path, points=4).read(("cabinet", "sofa"))
    assert {row.cls for row in rows} == {"cabinet", "sofa"}
    assert {row.split for row in rows} == {"train", "validation"}


def test_folders_that_do_not_fit(tmp_path):
    xyz_tree(tmp_path)
    (tmp_path / "cat").mkdir()
    with pytest.raises(DataError, match=f"{tmp_path}: unknown class 'cat'; known are bed, chair"):
        XyzTree(tmp_path, points=4).read(TWO)
    (tmp_path / "cat").rmdir()
    (tmp_path / "bed" / "dev").mkdir()
    with pytest.raises(DataError, match="unknown split 'dev'"):
        XyzTree(tmp_path, points=4).read(TWO)
    (tmp_path / "bed" / "dev").rmdir()
    xyz_tree(tmp_path, classes=("Chair",))
    with pytest.raises(DataError, match="are the same class"):
        XyzTree(tmp_path, points=4).read(TWO)


def test_an_empty_class_is_an_error(tmp_path):
    xyz_tree(tmp_path)
    for path in (tmp_path / "chair" / "test").iterdir():
        path.unlink()
    (tmp_path / "chair" / "test" / "readme.txt").write_text("moved")
    with pytest.raises(DataError, match="split 'test' has no clouds of chair"):
        XyzTree(tmp_path, points=4).read(TWO)
    with pytest.raises(DataError, match="holds no clouds"):
        XyzTree(tmp_path / "chair" / "test", points=4).read(TWO)


def test_hidden_files_are_passed_over(tmp_path):
    xyz_tree(tmp_path)
    (tmp_path / "__MACOSX" / "train").mkdir(parents=True)
    (tmp_path / ".git").mkdir()
    (tmp_path / "bed" / ".DS_Store").write_text("")
    (tmp_path / "bed" / "train" / "._a.xyz").write_bytes(b"\0")
    (tmp_path / "README").write_text("")
    assert len(XyzTree(tmp_path, points=4).read(TWO)[0]) == 8


def test_links_may_not_leave_the_folder(tmp_path):
    root = xyz_tree(tmp_path / "root")
    (root / "bed" / "train" / "inside.xyz").symlink_to(root / "bed" / "train" / "a.xyz")
    assert len(XyzTree(root, points=4).read(TWO)[0]) == 9
    (tmp_path / "secret.xyz").write_text("1 2 3\n")
    (root / "bed" / "train" / "c.xyz").symlink_to(tmp_path / "secret.xyz")
    with pytest.raises(DataError, match=r"c\.xyz is a link that leads out of"):
        XyzTree(root, points=4).read(TWO)
    (root / "bed" / "train" / "c.xyz").unlink()
    (root / "sofa").symlink_to(tmp_path)
    with pytest.raises(DataError, match="sofa is a link that leads out of"):
        XyzTree(root, points=4).read((*TWO, "sofa"))
    elsewhere = tmp_path / "link"  # the folder itself may be one: the user chose it
    (root / "sofa").unlink()
    elsewhere.symlink_to(root)
    assert len(XyzTree(elsewhere, points=4).read(TWO)[0]) == 9


def test_npy_axes(tmp_path):
    cloud = np.array([[1, 2, 3], [4, 5, 6]], "f4")
    for cls in ("chair", "plant"):
        (tmp_path / cls / "train").mkdir(parents=True)
        np.save(tmp_path / cls / "train" / "x.npy", cloud)
    importer = NpyTree(tmp_path, points=2, up="y", up_z_classes=["plant"])
    (chair, plant), _ = importer.read(("chair", "plant"))
    assert chair.tolist() == [[1, -3, 2], [4, -6, 5]]  # y is up in the file
    assert plant.tolist() == cloud.tolist()
    with pytest.raises(ConfigError, match=r"up_z_classes=plant: give a list, \[plant\]"):
        NpyTree(tmp_path, points=2, up="y", up_z_classes="plant")
    misspelt = NpyTree(tmp_path, points=2, up="y", up_z_classes=["plants"])
    with pytest.raises(ConfigError, match="names plants, but the classes are chair, plant"):
        misspelt.read(("chair", "plant"))


def test_npy_header_damaged_anywhere(tmp_path):
    path = tmp_path / "x.npy"
    np.save(path, np.ones((4, 3), "f4"))
    data = path.read_bytes()
    for at in range(128):  # an error, or still numbers
        changed = bytearray(data)
        changed[at] ^= 1 << (at % 8)
        path.write_bytes(changed)
        try:
            check_cloud(parse_cloud(path), 4, str(path))
        except DataError as error:
            assert "x.npy" in str(error)  # noqa: PT017


@pytest.mark.parametrize("array", [np.array(["a"]), np.ones((4, 2)), np.ones(3), np.ones((0, 3))])
def test_npy_of_other_things(tmp_path, array):
    np.save(tmp_path / "x.npy", array)
    with pytest.raises(DataError, match=r"x\.npy"):
        check_cloud(parse_cloud(tmp_path / "x.npy"), 4, str(tmp_path / "x.npy"))


def h5_file(path, n=2, points=4, **changes):
    content = {
        "data": np.arange(n * points * 6, dtype="f4").reshape(n, points, 6),
        "label": np.arange(n, dtype="i4")[:, None],
        **changes,
    }
    with h5py.File(path, "w") as file:
        for key, value in content.items():
            if value is not None:
                file[key] = value


def h5_folder(folder, **changes):
    folder.mkdir(exist_ok=True)
    for name in ("train_0", "train_1", "test_0"):
        h5_file(folder / f"{name}.h5", **changes)
    return folder


def test_h5_axes_and_mirror(tmp_path):
    h5_folder(tmp_path)
    (tmp_path / "test_0.h5").rename(tmp_path / "test_1.h5")
    assert PointDAH5(tmp_path).is_there()
    (tmp_path / "test_1.h5").rename(tmp_path / "away")
    assert not PointDAH5(tmp_path).is_there()  # both splits are needed
    (tmp_path / "away").rename(tmp_path / "test_0.h5")
    clouds, rows = PointDAH5(tmp_path, points=4, undo_mirror=False).read(TWO)
    assert clouds[0][:2].tolist() == [[0, -2, 1], [6, -8, 7]]  # (x, y, z) -> (x, -z, y)
    clouds, rows = PointDAH5(tmp_path, points=4).read(TWO)
    assert clouds[0][:2].tolist() == [[0, 2, 1], [6, 8, 7]]
    assert [row.id for row in rows] == [
        "bed/train/train_0_0000", "chair/train/train_0_0001",
        "bed/train/train_1_0000", "chair/train/train_1_0001",
        "bed/test/test_0_0000", "chair/test/test_0_0001",
    ]  # fmt: skip
    assert rows[3].origin == "train_1.h5[1]"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data": None}, "no dataset 'data'"),
        ({"label": None}, "no dataset 'label'"),
        ({"data": np.zeros((2, 4, 2), "f4")}, r"expected floats \[n, P, 3 or 6\]"),
        ({"data": np.zeros((2, 4, 3), "i4")}, "expected floats"),
        ({"label": np.array([0, 2])}, "cloud 1: label 2 is not 0..1"),
        ({"label": np.array([-1, 0])}, "cloud 0: label -1"),
        ({"label": np.zeros(3, "i4")}, r"expected integers \[2\]"),
        ({"label": np.zeros(2)}, "expected integers"),
        ({"data": np.full((2, 4, 6), np.nan)}, "cloud 0, point 1: .* is not finite"),
        ({"data": np.zeros((2, 5, 6))}, "the cloud has 5 points, expected 1 to 4"),
        ({"data": h5py.SoftLink("/label")}, "'data' is a link; refused"),
        ({"data": h5py.ExternalLink("/etc/passwd", "/x")}, "'data' is a link; refused"),
    ],
)
def test_h5_of_other_things(tmp_path, changes, message):
    h5_folder(tmp_path)
    h5_file(tmp_path / "train_1.h5", **changes)
    with pytest.raises(DataError, match=r"train_1\.h5.*" + message):
        PointDAH5(tmp_path, points=4).read(TWO)


def test_h5_whose_numbers_lie_elsewhere(tmp_path):
    root = h5_folder(tmp_path / "root")
    with h5py.File(root / "test_0.h5", "w") as file:
        file.create_dataset("data", (2, 4, 3), "f4", external=[("/etc/passwd", 0, 96)])
        file["label"] = np.arange(2)
    with pytest.raises(DataError, match="takes its numbers from other files"):
        PointDAH5(root, points=4).read(TWO)
    (root / "test_0.h5").rename(tmp_path / "outside.h5")
    (root / "test_0.h5").symlink_to(tmp_path / "outside.h5")
    with pytest.raises(DataError, match=r"test_0\.h5 is a link that leads out of"):
        PointDAH5(root, points=4).read(TWO)


def npz(folder, **changes):
    content = {
        "points": np.arange(4 * 2 * 3, dtype="f4").reshape(4, 2, 3),
        "cls": np.array(["bed", "chair", "bed", "chair"]),
        "split": np.array(["test", "train", "train", "test"]),
        "name": np.array(["a", "b", "c", "d"]),
        **changes,
    }
    np.savez(folder / "points.npz", **{k: v for k, v in content.items() if v is not None})
    return folder


def test_named_arrays(tmp_path):
    clouds, rows = NamedArrays(npz(tmp_path), points=2).read(TWO)
    assert [r.id for r in rows] == ["bed/train/c", "chair/train/b", "bed/test/a", "chair/test/d"]
    assert [cloud[0, 0] for cloud in clouds] == [12, 6, 0, 18]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": None}, r"has no arrays \['name'\]"),
        ({"cls": np.array([1, 2, 3, 4])}, "expected 4 strings"),
        ({"cls": np.array(["bed"])}, "expected 4 strings"),
        ({"cls": np.array(["bed", "chair", "cat", "bed"])}, r"cloud 2 \(c\): unknown class 'cat'"),
        ({"split": np.array(["x", "test", "test", "test"])}, "unknown split 'x'"),
        ({"points": np.zeros((4, 2, 2))}, r"not floats \[N, P, 3\]"),
        ({"points": np.array([Trap()] * 4)}, "pickled array, refused"),
    ],
)
def test_named_arrays_of_other_things(tmp_path, changes, message, monkeypatch):
    monkeypatch.setenv("QS3_TRAP", str(tmp_path / "trap"))
    with pytest.raises(DataError, match=r"points\.npz.*" + message):
        NamedArrays(npz(tmp_path, **changes), points=2).read(TWO)
    assert not (tmp_path / "trap").exists()


@pytest.mark.parametrize("kind", ["h5", "npz"])
def test_truncated_files_of_all_clouds(tmp_path, kind):
    if kind == "h5":
        path, importer = h5_folder(tmp_path) / "train_0.h5", PointDAH5(tmp_path, points=4)
    else:
        path, importer = npz(tmp_path) / "points.npz", NamedArrays(tmp_path, points=2)
    data = path.read_bytes()
    for size in range(0, len(data), 97):
        path.write_bytes(data[:size])
        with pytest.raises(DataError, match=rf"{path.name}: not a readable"):
            importer.read(TWO)


def test_wrong_settings(tmp_path):
    for settings in ({"points": 0}, {"up": "w"}, {"on_error": "ignore"}):
        with pytest.raises(ConfigError):
            XyzTree(tmp_path, **settings)


def test_import_is_all_or_nothing(tmp_path):
    xyz_tree(tmp_path / "p")
    bad = tmp_path / "p" / "bed" / "test" / "a.xyz"
    good = bad.read_text()
    bad.write_text("1 2\n")
    importer = XyzTree(tmp_path / "p", points=4)
    with pytest.raises(DataError):
        import_into(tmp_path / "s", importer, name="s", classes=TWO)
    assert not (tmp_path / "s").exists()
    bad.write_text(good)
    (tmp_path / ".s.importing").mkdir()  # what a kill would leave
    (tmp_path / ".s.importing" / "points.npy").write_text("half")
    import_into(tmp_path / "s", importer, name="s", classes=TWO)
    assert sorted(p.name for p in (tmp_path / "s").iterdir()) == [
        "manifest.csv", "meta.yaml", "points.npy",
    ]  # fmt: skip
    assert not (tmp_path / ".s.importing").exists()
    before = (tmp_path / "s" / "meta.yaml").stat().st_ino
    import_into(tmp_path / "s", importer, name="s", classes=TWO)  # once is enough
    assert (tmp_path / "s" / "meta.yaml").stat().st_ino == before


def test_folders_that_are_in_the_way(tmp_path):
    importer, folder = XyzTree(xyz_tree(tmp_path / "p"), points=4), tmp_path / "s"
    folder.mkdir()
    (folder / "part.npz").write_text("")
    with pytest.raises(DataError, match="holds a generation that was not finished"):
        import_into(folder, importer, name="s", classes=TWO)
    (folder / "part.npz").rename(folder / ".lock")  # of a generation that was refused at once
    import_into(folder, importer, name="s", classes=TWO)
    assert len(open_pointset(folder)) == 8


def test_kill_9_during_an_import(tmp_path):
    """Whenever the import is killed, there is no store or a whole one; then it is made."""
    xyz_tree(tmp_path / "p", names=[f"{i:02d}" for i in range(60)], rows=200)
    code = (
        "import sys; from pathlib import Path\n"
        "from qs3.datasets.importers import XyzTree, import_into\n"
        "print('go', flush=True)\n"
        "import_into(Path(sys.argv[1]), XyzTree(sys.argv[2], points=200), name='s',\n"
        "            classes=('bed', 'chair'))\n"
    )
    for delay in (0.0, 0.02, 0.05, 0.08, 0.12):
        process = subprocess.Popen(
            [sys.executable, "-c", code, tmp_path / "s", tmp_path / "p"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(delay)
        process.kill()
        process.wait()
        process.stdout.close()
        if (tmp_path / "s").exists():
            assert len(open_pointset(tmp_path / "s")) == 240
    importer = XyzTree(tmp_path / "p", points=200)
    import_into(tmp_path / "s", importer, name="s", classes=TWO)
    assert len(open_pointset(tmp_path / "s")) == 240
    assert not (tmp_path / ".s.importing").exists()
