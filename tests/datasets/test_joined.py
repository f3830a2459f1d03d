"""Several datasets as one: all their clouds, an object's scans known as such, and stale joins."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from qs3.datasets.domain import Domain
from qs3.datasets.joined import Joined
from qs3.errors import DataError, MissingDataError
from qs3.store.meta import MadeOf, ManifestRow, read_manifest
from qs3.store.store import open_pointset, write_pointset
from tests.fixtures.published import cloud

CLASSES = ("bed", "chair")


def write(folder: Path, ids: list[str], points: int = 32, measured: int = 0, **more) -> None:
    """A dataset of these objects, whose clouds depend on the folder's name, too."""
    rows = [
        ManifestRow(*(name, *name.split("/")[:2]), valid_points=measured or points, seed=7)
        for name in ids
    ]
    rows.append(ManifestRow("bed/train/lost", "bed", "train", status="failed", reason="dark"))
    write_pointset(
        folder, name=folder.name, classes=CLASSES, rows=rows,
        arrays={"points": [cloud(row.cls, folder.name + row.id, points) for row in rows[:-1]]},
        meta=MadeOf(objects="embedded catalogue", **more).meta,
    )  # fmt: skip


def joined(tmp_path: Path, *names: str, **more) -> Domain:
    importer = Joined(tmp_path, points=48, datasets=list(names))
    return Domain(
        "joined", "J", "J", tmp_path / "joined", published=importer, classes=list(CLASSES), **more
    )


def test_all_clouds_are_there_and_scans_of_an_object_are_called_so(tmp_path):
    write(tmp_path / "a", ["bed/train/1", "bed/train/1~1", "chair/test/1"], sensor="x", views=1)
    write(tmp_path / "b", ["bed/train/1", "chair/train/2"], points=48, sensor="y", views=5)
    data = joined(tmp_path, "a", "b").open()
    assert data.ids == (
        *("bed/train/1", "bed/train/1~1", "bed/train/1~2", "chair/train/2", "chair/test/1"),
    )
    rows = read_manifest(tmp_path / "joined")
    assert [row.origin for row in rows] == [
        *("a/bed/train/1", "a/bed/train/1~1", "b/bed/train/1", "b/chair/train/2", "a/chair/test/1"),
    ]
    assert [row.more["dataset"] for row in rows] == ["a", "a", "b", "b", "a"]
    assert {row.seed for row in rows} == {7}
    a, b = open_pointset(tmp_path / "a"), open_pointset(tmp_path / "b")
    np.testing.assert_array_equal(data.points[0][:32], a.points[0])
    np.testing.assert_array_equal(data.points[0][32:], a.points[0][:16])  # filled up
    np.testing.assert_array_equal(data.points[2], b.points[0])
    assert [row.valid_points for row in rows] == [32, 32, 48, 48, 32]
    assert str(data.made_of) == "embedded catalogue, x and y, 2 datasets joined"
    assert not data.made_of.published


def test_a_change_of_a_dataset_is_noticed_and_its_absence_is_none(tmp_path):
    write(tmp_path / "a", ["bed/train/1"])
    write(tmp_path / "b", ["bed/train/2"])
    domain = joined(tmp_path, "a", "b")
    before = domain.open().sha256
    assert domain.open().sha256 == before
    shutil.rmtree(tmp_path / "b")
    write(tmp_path / "b", ["bed/train/3"])
    with pytest.raises(DataError):
        domain.open()
    with pytest.raises(DataError):
        joined(tmp_path, "a").open()
    shutil.rmtree(tmp_path / "a")
    shutil.rmtree(tmp_path / "b")
    assert domain.open().sha256 == before


def test_what_is_missing_or_does_not_fit_is_named(tmp_path):
    write(tmp_path / "a", ["bed/train/1"])
    with pytest.raises(MissingDataError):
        joined(tmp_path, "a", "b").open()
    with pytest.raises(MissingDataError):
        joined(tmp_path).open()
    with pytest.raises(DataError):
        joined(tmp_path, "a", "a").open()
    write(tmp_path / "b", ["bed/train/1"], points=50)
    with pytest.raises(DataError):
        joined(tmp_path, "a", "b").open()
    write_pointset(
        tmp_path / "c", name="c", classes=("bed",), meta={},
        rows=[ManifestRow("bed/train/1", "bed", "train")], arrays={"points": np.zeros((1, 4, 3))},
    )  # fmt: skip
    with pytest.raises(DataError):
        joined(tmp_path, "a", "c").open()
