"""An archive of cut objects: parts, folds, stray points."""

import numpy as np
import pytest

from qs3.datamodules.domain import DomainData
from qs3.errors import DataError
from qs3.store.meta import is_finished, read_manifest
from tests.composing import compose_domain
from tests.fixtures.frame_files import write_archive


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("archive") / "mine.npz"
    return path, write_archive(path)


def domain(file, folder, **more):
    keys = {"paths.data_dir": str(folder), "published.file": str(file)}
    return compose_domain("objects", {**keys, **{f"published.{k}": v for k, v in more.items()}})


def test_points_classes_and_parts(file, tmp_path):
    path, arrays = file
    found = domain(path, tmp_path)
    data = found.open()
    rows = read_manifest(found.folder)
    assert data.counts() == {
        split: dict.fromkeys(data.classes, count) for split, count in (("train", 4), ("test", 2))
    }
    for row, cloud in zip(rows, data.points, strict=True):
        i = int(row.id.rsplit("_", 1)[1])
        part = slice(arrays["start"][i], arrays["start"][i + 1])
        xyz = arrays["xyz_tenth_mm"][part][arrays["inlier"][part]] / 1e4 + arrays["centre_m"][i]
        np.testing.assert_allclose(cloud[: len(xyz)], xyz, atol=1e-6)
        assert row.valid_points == len(xyz)
        assert row.cls == arrays["cls"][i]
        assert row.more == {
            "frame": str(arrays["img"][i]), "sub": arrays["sub"][i], "tier": arrays["tier"][i],
        }  # fmt: skip
        block = f"block{arrays['img'][i] // 30:04d}"
        assert found.importer().object_of(row.id) == block
    assert str(data.made_of).startswith("real objects cut from depth images, archive ")


def test_folds_part_the_training_part_and_keep_away(file, tmp_path):
    path, arrays = file
    tested = []
    for fold in range(2):
        importer = domain(path, tmp_path, fold=str(fold), folds="2", gap="9", block="7").importer()
        items = importer.items(tuple(np.unique(arrays["cls"])))
        split = {int(item.row.id.rsplit("_", 1)[1]): item.row.split for item in items}
        assert {arrays["dev"][i] for i in split} == {"adapt"}
        test = [i for i in split if split[i] == "test"]
        train = [i for i in split if split[i] == "train"]
        assert train
        apart = np.abs(arrays["img"][train][:, None] - arrays["img"][test][None]).min()
        assert apart > 9
        tested += test
    assert sorted(tested) == np.flatnonzero(arrays["dev"] == "adapt").tolist()
    for more in ({"fold": "0", "block": "1000"}, {"fold": "5"}):
        with pytest.raises(AssertionError):
            domain(path, tmp_path, **more).open()


def test_without_parts_all_of_it_judges(tmp_path):
    write_archive(tmp_path / "held_back.npz", {"test": 2}, dev=False)
    data = domain(tmp_path / "held_back.npz", tmp_path)
    assert set(data.open().splits) == {"test"}
    target = DomainData(data, labels=False, points=4)
    with pytest.raises(DataError):
        target.setup("fit")
    with pytest.raises(AssertionError):
        domain(tmp_path / "held_back.npz", tmp_path / "0", fold="0").open()


def test_a_copy_elsewhere_is_the_same_archive_and_other_objects_are_not(file, tmp_path):
    path, arrays = file
    domain(path, tmp_path).open()
    moved = tmp_path / "elsewhere" / "other.npz"
    moved.parent.mkdir()
    moved.write_bytes(path.read_bytes())
    domain(moved, tmp_path).open()
    arrays = {key: np.array(value) for key, value in arrays.items()}
    arrays["xyz_tenth_mm"][0, 0] += 1
    np.savez_compressed(path.with_name("changed.npz"), **arrays)
    with pytest.raises(DataError):
        domain(path.with_name("changed.npz"), tmp_path).open()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("start", "reversed"),
        ("centre_m", "nan"),
        ("tier", "good"),
        ("dev", "short"),
        ("cls", "throne"),
    ],
)
def test_arrays_that_do_not_fit_together(tmp_path, key, value):
    arrays = write_archive(tmp_path / "x.npz", {"train": 1, "test": 1})
    changed = {
        "reversed": arrays["start"][::-1],
        "nan": np.full_like(arrays["centre_m"], np.nan),
        "short": arrays["dev"][1:],
    }
    arrays[key] = changed.get(value, np.full(len(arrays["cls"]), value))
    np.savez(tmp_path / "x.npz", **arrays)
    with pytest.raises(DataError, match=r"x\.npz"):
        domain(tmp_path / "x.npz", tmp_path).open()
    assert not is_finished(tmp_path / "objects")
