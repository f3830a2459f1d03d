"""ModelNet from its meshes: the same as through PyG where PyG is right, and errors where not."""

import numpy as np
import pytest

from qs3.classes import CLASSES
from qs3.datasets.published import ModelNetMeshes
from tests.fixtures.modelnet import write_off_tree

SPLITS = {"train": 2, "test": 1}


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
