"""Published formats: known answers, then every kind of damage we could think of."""

import os
import shutil
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest

from qs3.datasets.domain import Domain
from qs3.datasets.importing import check_cloud, import_into
from qs3.datasets.published import GraspNetPC, NamedArrays, PointDAH5, PublishedTree
from qs3.errors import DataError
from qs3.store.meta import ManifestRow
from qs3.store.store import open_pointset
from qs3.training.load import objects_by_id

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
    importer = PublishedTree(xyz_tree(tmp_path), points=4)
    assert importer.is_there()
    clouds, rows = importer.read(TWO, tmp_path)
    assert [row.id for row in rows] == [
        "bed/train/a", "bed/train/b", "chair/train/a", "chair/train/b",
        "bed/test/a", "bed/test/b", "chair/test/a", "chair/test/b",
    ]  # fmt: skip
    assert [cloud[0, 0] for cloud in clouds] == [0, 1, 100, 101, 10, 11, 110, 111]
    assert clouds[0].tolist() == np.arange(12).reshape(4, 3).tolist()
    assert clouds[0].dtype == np.float32
    assert rows[0].origin == os.path.join("bed", "train", "a.xyz")
    assert {row.valid_points for row in rows} == {4}


def test_an_empty_class_is_named_and_an_empty_folder_is_an_error(tmp_path, caplog):
    xyz_tree(tmp_path)
    for path in (tmp_path / "chair" / "test").iterdir():
        path.unlink()
    (tmp_path / "chair" / "test" / "readme.txt").write_text("moved")
    PublishedTree(tmp_path, points=4).read(TWO, tmp_path)
    assert "split 'test' has no clouds of chair" in caplog.text
    with pytest.raises(DataError):
        PublishedTree(tmp_path / "chair" / "test", points=4).read(TWO, tmp_path)


def test_npy_axes(tmp_path):
    cloud = np.array([[1, 2, 3], [4, 5, 6]], "f4")
    for cls in ("chair", "plant"):
        (tmp_path / cls / "train").mkdir(parents=True)
        np.save(tmp_path / cls / "train" / "x.npy", cloud)
    importer = PublishedTree(tmp_path, points=2, up="y", up_z_classes=["plant"])
    (chair, plant), _ = importer.read(("chair", "plant"), tmp_path)
    assert chair.tolist() == [[1, -3, 2], [4, -6, 5]]  # y is up in the file
    assert plant.tolist() == cloud.tolist()


def test_h5_axes_and_mirror(tmp_path):
    for name in ("train_0", "train_1", "test_0"):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file["data"] = np.arange(2 * 4 * 6, dtype="f4").reshape(2, 4, 6)
            file["label"] = np.arange(2, dtype="i4")[:, None]
    (tmp_path / "test_0.h5").rename(tmp_path / "test_1.h5")
    assert PointDAH5(tmp_path).is_there()
    (tmp_path / "test_1.h5").rename(tmp_path / "away")
    assert not PointDAH5(tmp_path).is_there()  # both splits are needed
    (tmp_path / "away").rename(tmp_path / "test_0.h5")
    clouds, rows = PointDAH5(tmp_path, points=4, form="mirrored").read(TWO, tmp_path)
    assert clouds[0][:2].tolist() == [[0, -2, 1], [6, -8, 7]]  # (x, y, z) -> (x, -z, y)
    clouds, rows = PointDAH5(tmp_path, points=4).read(TWO, tmp_path)
    assert clouds[0][:2].tolist() == [[0, 2, 1], [6, 8, 7]]
    assert [row.id for row in rows] == [
        "bed/train/train_0_0000", "chair/train/train_0_0001",
        "bed/train/train_1_0000", "chair/train/train_1_0001",
        "bed/test/test_0_0000", "chair/test/test_0_0001",
    ]  # fmt: skip
    assert rows[3].origin == "train_1.h5[1]"


def test_named_arrays(tmp_path):
    np.savez(
        tmp_path / "points.npz",
        points=np.arange(4 * 2 * 3, dtype="f4").reshape(4, 2, 3),
        cls=["bed", "chair", "bed", "chair"],
        split=["test", "train", "train", "test"],
        name=["a", "b", "c", "d"],
    )
    clouds, rows = NamedArrays(tmp_path, points=2).read(TWO, tmp_path)
    assert [r.id for r in rows] == ["bed/train/c", "chair/train/b", "bed/test/a", "chair/test/d"]
    assert [cloud[0, 0] for cloud in clouds] == [12, 6, 0, 18]


def test_import_is_all_or_nothing(tmp_path):
    xyz_tree(tmp_path / "p")
    bad = tmp_path / "p" / "bed" / "test" / "a.xyz"
    good = bad.read_text()
    bad.write_text("1 2\n")
    importer = PublishedTree(tmp_path / "p", points=4)
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


@pytest.mark.slow
def test_kill_9_during_an_import(tmp_path):
    """Whenever the import is killed, there is no store or a whole one; then it is made."""
    xyz_tree(tmp_path / "p", names=[f"{i:02d}" for i in range(60)], rows=200)
    code = (
        "import sys; from pathlib import Path\n"
        "from qs3.datasets.published import PublishedTree\n"
        "from qs3.datasets.importing import import_into\n"
        "print('go', flush=True)\n"
        "import_into(Path(sys.argv[1]), PublishedTree(sys.argv[2], points=200), name='s',\n"
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
    importer = PublishedTree(tmp_path / "p", points=200)
    import_into(tmp_path / "s", importer, name="s", classes=TWO)
    assert len(open_pointset(tmp_path / "s")) == 240
    assert not (tmp_path / ".s.importing").exists()


@pytest.mark.parametrize(
    "cloud",
    [
        np.ones((5, 3)),
        np.ones((0, 3)),
        np.ones((4, 2)),
        np.ones(3),
        [[1, 2, np.nan]],
        [[1, 2, 1e39]],
    ],
)
def test_clouds_that_were_not_published_so(cloud):
    with pytest.raises(DataError, match="where"):
        check_cloud(np.array(cloud), 4, "where")


def test_folders_that_do_not_fit(tmp_path):
    xyz_tree(tmp_path)
    xyz_tree(tmp_path, classes=("cat",))
    with pytest.raises(DataError, match="cat"):
        PublishedTree(tmp_path, points=4).read(TWO, tmp_path)
    shutil.rmtree(tmp_path / "cat")
    (tmp_path / "bed" / "test").rename(tmp_path / "bed" / "dev")
    with pytest.raises(DataError, match="dev"):
        PublishedTree(tmp_path, points=4).read(TWO, tmp_path)


def test_which_clouds_show_the_same_object(tmp_path):
    tree = PublishedTree(tmp_path)
    assert tree.object_of("chair/test/scene0011_01_7") == "scene0011"
    assert tree.object_of("bed/test/scene0011_00") == "scene0011"
    assert tree.object_of("chair/train/scene_0011_0123") == ""
    assert GraspNetPC(tmp_path).object_of("3/test/kinect_scene_0100_0007") == "3"
    rows = [
        ManifestRow("bed/test/scene0001_00_1", "bed", "test"),
        ManifestRow("bed/test/other", "bed", "test"),
        ManifestRow("bed/test/scene0002_00_1", "bed", "test", mesh_sha256="f" * 64),
    ]
    known = {rows[2].id: "f" * 64}
    for published, more in ((None, {}), (tree, {rows[0].id: "scene0001"})):
        made = Domain("d", "D", "D", tmp_path / "x", published=published, classes=["bed"])
        assert objects_by_id(rows, made) == known | more
