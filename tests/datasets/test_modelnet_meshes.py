"""ModelNet from its meshes: the same as through PyG where PyG is right, and errors where not."""

from pathlib import Path

import numpy as np
import pytest

from qs3.classes import CLASSES
from qs3.datasets.folders import ModelNetMeshes, sample_file
from qs3.errors import DataError
from qs3.meshes.io import load_mesh
from tests.fixtures.modelnet import OTHERS, TEN, off_text, write_off_tree

SPLITS = {"train": 2, "test": 1}
ARRAYS = Path(__file__).parents[3] / "shared" / "data" / "modelnet10_points.npz"


@pytest.fixture(scope="module")
def modelnet(tmp_path_factory):
    """Root of PyG's dataset, as PyG leaves it after its download."""
    root = tmp_path_factory.mktemp("modelnet")
    write_off_tree(root / "raw", SPLITS)
    return root


def read(folder, **more):
    clouds, rows = ModelNetMeshes(folder, **more).read(CLASSES, folder)
    return {row.id: cloud for row, cloud in zip(rows, clouds, strict=True)}, rows


def test_order_names_and_seeds(modelnet):
    clouds, rows = read(modelnet, points=64)
    assert [row.cls for row in rows] == [c for c in CLASSES for _ in range(2)] + list(CLASSES)
    assert [row.split for row in rows] == ["train"] * 20 + ["test"] * 10
    assert rows[6].id == "cabinet/train/night_stand_0001"
    assert rows[6].origin == "night_stand/train/night_stand_0001.off"
    assert len({row.seed for row in rows}) == 30
    assert {row.valid_points for row in rows} == {64}
    assert all(cloud.shape == (64, 3) and cloud.dtype == np.float32 for cloud in clouds.values())


def test_the_tree_is_found_where_others_keep_it(modelnet, tmp_path):
    expected, _ = read(modelnet, points=8)
    for below in ("raw", "ModelNet40", ""):
        (tmp_path / "x").mkdir()
        (tmp_path / "x" / below).parent.mkdir(exist_ok=True)
        write_off_tree(tmp_path / "x" / below, SPLITS)
        found, _ = read(tmp_path / "x", points=8)
        assert all(np.array_equal(found[key], expected[key]) for key in expected)
        (tmp_path / "x").rename(tmp_path / f"done{below}")
    assert not ModelNetMeshes(tmp_path / "nowhere").is_there()


def test_pygs_dataset_opens_the_same_files_and_reads_the_same_meshes(modelnet):
    """PyG makes no download: the folder is as it expects it."""
    from torch_geometric.datasets import ModelNet

    names = sorted([*TEN, *OTHERS])
    for split in ("train", "test"):
        data = ModelNet(str(modelnet), name="40", train=split == "train")
        ours = {
            item.where: load_mesh(Path(item.where))
            for item in ModelNetMeshes(modelnet).items(CLASSES)
            if item.row.split == split
        }
        matched = 0
        for theirs in data:
            name = names[int(theirs.y)]
            if name in OTHERS:
                continue
            same = [
                where
                for where, mesh in ours.items()
                if Path(where).parts[-3] == name
                and mesh.vertices.shape == tuple(theirs.pos.shape)
                and np.array_equal(mesh.vertices.astype("f4"), theirs.pos.numpy())
                and np.array_equal(mesh.faces, theirs.face.T.numpy())
            ]
            assert len(same) == 1
            matched += 1
        assert matched == len(ours) == 10 * SPLITS[split]


def test_a_cloud_depends_on_its_own_seed_only(modelnet, tmp_path):
    first, _ = read(modelnet, points=32)
    again, _ = read(modelnet, points=32)
    other, _ = read(modelnet, points=32, seed=1)
    assert all(np.array_equal(first[key], again[key]) for key in first)
    assert not any(np.array_equal(first[key], other[key]) for key in first)
    write_off_tree(tmp_path, SPLITS)  # the same without some of its neighbours
    for path in tmp_path.glob("*/train/*_0001.off"):
        path.unlink()
    fewer, _ = read(tmp_path, points=32)
    assert len(fewer) == 20
    assert all(np.array_equal(first[key], fewer[key]) for key in fewer)


@pytest.mark.skipif(not ARRAYS.is_file(), reason="../shared/data is not there")
def test_counts_of_the_official_split(tmp_path):
    """Names and split of PointDA-10's list, put into ModelNet40's folders; no file is opened."""
    with np.load(ARRAYS) as arrays:
        names = list(zip(arrays["name"].tolist(), arrays["split"].tolist(), strict=True))
    for name, split in names:
        folder = tmp_path / name.rpartition("_")[0] / split
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.off").touch()
    for other in ("airplane", "dresser", "wardrobe"):
        (tmp_path / other / "train").mkdir(parents=True)
        (tmp_path / other / "train" / f"{other}_0001.off").touch()
    rows = [item.row for item in ModelNetMeshes(tmp_path).items(CLASSES)]
    assert sum(row.split == "train" for row in rows) == 4183
    assert sum(row.split == "test" for row in rows) == 856
    train = [sum(r.cls == c and r.split == "train" for r in rows) for c in CLASSES]
    test = [sum(r.cls == c and r.split == "test" for r in rows) for c in CLASSES]
    assert train == [106, 515, 572, 200, 889, 124, 465, 240, 680, 392]
    assert test == [50, 100, 100, 86, 100, 20, 100, 100, 100, 100]
    assert {(Path(row.origin).stem, row.split) for row in rows} == set(names)


SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 1.5, 0]])
GOOD = off_text(SQUARE, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    ("text", "message", "pyg"),
    [
        # what PyG's reader makes of it: the number of faces, or its exception
        (off_text(SQUARE, [[0, 1, 2, 3, 4], [0, 1, 2]]), None, 1),
        (GOOD.replace("OFF\n5 2 0", "OFF5 2 0"), None, 2),
        ("\n".join(GOOD.splitlines()[:-1]) + "\n", "truncated", 1),
        (GOOD.replace("3 0 2 3", "3 0 2 9"), "vertex 9, but there are 5", 2),
        (GOOD.replace("0.500000", "nan"), "not finite", 2),
        (off_text(np.zeros((3, 3)), [[0, 1, 2]]), "zero area", 1),
        ("", "is empty", IndexError),
    ],
)
def test_readers_on_odd_and_damaged_files(tmp_path, text, message, pyg):
    from torch_geometric.io import read_off

    path = tmp_path / "chair_0001.off"
    path.write_text(text)
    if isinstance(pyg, int):
        assert read_off(str(path)).face.reshape(3, -1).shape[1] == pyg
    else:
        with pytest.raises(pyg):
            read_off(str(path))
    if message is None:
        assert np.isfinite(sample_file(path, 16, 0)).all()
    else:
        with pytest.raises(DataError):
            sample_file(path, 16, 0)
