"""A small folder of meshes and the dataset made of it, shared by all tests that only read them."""

import pytest
import trimesh

from qs3.generation.command import generate
from tests.generation.generating import config


@pytest.fixture(scope="session")
def meshes(tmp_path_factory):
    """Three classes of two objects in train and one in test."""
    root = tmp_path_factory.mktemp("meshes")
    solids = {
        "chair": lambda i: trimesh.creation.box((0.5, 0.5, 0.9 + 0.1 * i)),
        "table": lambda i: trimesh.creation.cylinder(0.6 + 0.1 * i, 0.7),
        "lamp": lambda i: trimesh.creation.icosphere(3, 0.3 + 0.05 * i),
    }
    for cls, make in solids.items():
        for split, count in (("train", 2), ("test", 1)):
            folder = root / cls / split
            folder.mkdir(parents=True)
            for i in range(count):
                make(i + 2 * (split == "test")).export(folder / f"{cls}_{i}.ply")
    return root


@pytest.fixture(scope="session")
def finished(meshes, tmp_path_factory):
    """The dataset that every other way of making it must equal."""
    data_dir = tmp_path_factory.mktemp("data")
    pointset = generate(config(data_dir, meshes, "workers=0"))
    return data_dir / "specklenet10", pointset
