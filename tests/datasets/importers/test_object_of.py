"""Which clouds show the same object, as far as ids tell."""

from pathlib import Path

from qs3.datasets.domain import Domain
from qs3.datasets.importers import GraspNetPC, XyzTree
from qs3.store.store import ManifestRow, write_pointset
from qs3.training.load import _objects_by_id
from tests.fixtures.published import cloud


def test_rooms_of_scannet_and_objects_of_graspnet(tmp_path):
    tree, grasp = XyzTree(tmp_path), GraspNetPC(tmp_path)
    assert tree.object_of("chair/test/scene0011_01_7") == "scene0011"
    assert tree.object_of("bed/test/scene0011_00") == "scene0011"
    assert tree.object_of("chair/train/chair_0001") == ""
    assert tree.object_of("chair/train/scene_0011_0123") == ""
    assert grasp.object_of("3/test/kinect_scene_0100_0007") == "3"


def domain(path: Path, published: XyzTree | None) -> Domain:
    return Domain("d", "D", "D", path, published=published, classes=["bed"])


def test_meshes_first_then_ids_then_nothing(tmp_path):
    rows = [
        ManifestRow("bed/test/scene0001_00_1", "bed", "test"),
        ManifestRow("bed/test/other", "bed", "test"),
        ManifestRow("bed/test/scene0002_00_1", "bed", "test", mesh_sha256="f" * 64),
    ]
    data = write_pointset(
        tmp_path / "x", name="x", classes=("bed",), rows=rows, meta={},
        arrays={"points": [cloud("bed", row.id, 16) for row in rows]},
    )  # fmt: skip
    known = {"bed/test/scene0002_00_1": "f" * 64}
    assert _objects_by_id(data, domain(tmp_path / "x", None)) == known
    known["bed/test/scene0001_00_1"] = "scene0001"
    assert _objects_by_id(data, domain(tmp_path / "x", XyzTree(tmp_path))) == known
