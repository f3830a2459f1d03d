"""From rendered rooms in ScanNet's formats to clouds on their objects."""

import hashlib
import shutil

import numpy as np
import pytest
import trimesh
from trimesh.proximity import closest_point_naive

from qs3.classes import CLASSES
from qs3.datasets.domain import Domain
from qs3.datasets.importing import import_into
from qs3.datasets.published import PublishedTree
from qs3.datasets.scannet import ScanNet
from qs3.errors import DataError
from qs3.store.meta import read_manifest
from qs3.store.store import open_pointset
from tests.datasets.conftest import LOST
from tests.datasets.writing import ID_OF, write_zip
from tests.running import main

TRAIN, VAL = "scene0001_00", "scene0007_01"


def run(root, out, **more):
    lists = {key: str(root / f"{key}.txt") for key in ("train", "val")}
    settings = {"labels": str(root / "labels.tsv"), "min_points": 600, **lists, **more}
    import_into(out, ScanNet(root / "scans", **settings), name="depthscannet10", classes=CLASSES)
    return open_pointset(out)


def contents(folder):
    """Hash of every file that is not hidden, by its name in the folder."""
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.iterdir()
        if not path.name.startswith(".")
    }


@pytest.fixture(scope="module")
def finished(written, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "depthscannet10"
    return out, run(written, out)


def test_every_object_of_the_ten_classes_is_found_and_no_other(finished):
    out, pointset = finished
    assert pointset.ids == (
        f"chair/train/{TRAIN}_0", f"sofa/train/{TRAIN}_1", f"table/train/{TRAIN}_2",
        f"chair/test/{VAL}_0", f"sofa/test/{VAL}_1", f"table/test/{VAL}_2",
    )  # fmt: skip
    assert pointset.points.shape == (6, 2048, 3)
    rows = read_manifest(out)
    assert rows[0].origin.startswith(f"scene {TRAIN}, object 2, label 'chairs', frames 0 ")
    for row in rows:
        frames = row.origin.split("frames ")[1].split(",")[0].split()
        assert not {int(frame) for frame in frames} & set(LOST)
        assert 1 < len(frames) == row.views <= 10
    assert pointset.meta["extraction"]["min_points"] == 600
    tree = PublishedTree(out.parent / "published")  # as conf/domain/depthscannet10.yaml has it
    found = Domain("depthscannet10", "D", "DepthScanNet10", out, published=tree)
    assert found.open().sha256 == pointset.sha256
    assert tree.object_of(pointset.ids[0]) == "scene0001"


def test_each_cloud_lies_on_its_object(finished, recorded):
    """Depth is stored in millimetres: half of one, along the ray, is all the error there is."""
    out, pointset = finished
    rows = read_manifest(out)
    for row, cloud in zip(rows, pointset.points, strict=True):
        scene, number = row.origin.split(", object ")
        mesh = recorded[scene.split()[1]][0].bodies[int(number.split(",")[0])].mesh
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        assert closest_point_naive(solid, cloud[::16].astype(float))[1].max() < 0.00055, row.id
        # Seen from 200 degrees about it, the cloud reaches the object's extent, and z is up.
        low, high = mesh.bounds
        assert cloud[:, 2].max() > high[2] - 0.03
        assert (np.ptp(cloud, axis=0) > 0.85 * (high - low)).all(), row.id


@pytest.mark.slow
def test_workers_change_no_byte_and_settings_are_heeded(finished, written, tmp_path):
    run(written, tmp_path / "d", workers=2)
    assert contents(tmp_path / "d") == contents(finished[0])
    run(written, tmp_path / "few", views=2, stride=2)
    for row in read_manifest(tmp_path / "few"):
        frames = [int(n) for n in row.origin.split("frames ")[1].split(",")[0].split()]
        assert len(frames) <= 2
        assert all(frame % 2 == 0 for frame in frames)
    run(written, tmp_path / "large", min_points=5000)
    rows = {row.id: row.status for row in read_manifest(tmp_path / "large")}
    assert rows[f"chair/train/{TRAIN}_0"] == "skipped"
    assert rows[f"sofa/train/{TRAIN}_1"] == "ok"
    with pytest.raises(DataError):
        run(written, tmp_path / "none", min_points=10**6)


def test_a_broken_recording_stops_and_is_gone_on_with_when_it_is_whole(written, finished, tmp_path):
    root, out = tmp_path / "in", tmp_path / "d"
    shutil.copytree(written, root)
    path = root / "scans" / VAL / f"{VAL}.sens"
    whole = path.read_bytes()
    path.write_bytes(whole[: 2 * len(whole) // 3])
    with pytest.raises(DataError, match=rf"{VAL}\.sens"):
        run(root, out)
    assert len(list((tmp_path / ".d.parts" / "parts").glob("*.npz"))) == 1
    assert set(run(root, tmp_path / "rest", on_error="skip").splits) == {"train"}
    path.write_bytes(whole)
    assert run(root, out).sha256 == finished[1].sha256
    path.unlink()
    with pytest.raises(DataError, match=rf"{VAL}\.sens"):
        run(root, tmp_path / "gone")


def test_label_masks_that_deny_the_class_are_heeded(written, finished, recorded, tmp_path):
    """All of the chair is a lamp there, and a strip of the sofa is a wall."""
    root = tmp_path / "in"
    shutil.copytree(written, root)
    made, _, masks = recorded[TRAIN]
    lut = np.zeros(256, np.uint16)
    for number, word in made.words.items():
        lut[number + 1] = ID_OF[word]
    labels = {}
    for frame, mask in masks.items():
        labels[frame] = lut[mask]
        labels[frame][mask == 2 + 1] = ID_OF["lamp"]
        strip = mask[150:170] == 4 + 1
        labels[frame][150:170][strip] = ID_OF["wall"]
    write_zip(root / "scans" / TRAIN / f"{TRAIN}_2d-label-filt.zip", "label-filt", labels)
    run(root, tmp_path / "out")
    rows = {row.id: row for row in read_manifest(tmp_path / "out")}
    chair, sofa = rows[f"chair/train/{TRAIN}_0"], rows[f"sofa/train/{TRAIN}_1"]
    assert (chair.status, sofa.status) == ("skipped", "ok")
    before = next(r for r in read_manifest(finished[0]) if r.id == sofa.id)
    assert sofa.origin == before.origin  # the same frames, without the strip
    assert 0 < before.valid_points - sofa.valid_points < 0.3 * before.valid_points


def command(root, out, *more):
    return [
        "scannet", f"scans={root}/scans", f"labels={root}/labels.tsv", f"train={root}/train.txt",
        f"val={root}/val.txt", f"out={out}", "min_points=600", *more,
    ]  # fmt: skip


def test_the_command(written, finished, tmp_path, capsys):
    assert main(command(written, tmp_path / "d", "workers=0")) == 0
    assert open_pointset(tmp_path / "d").sha256 == finished[1].sha256
    assert main(command(written, tmp_path / "e", "views=none")) == 1
    assert "views" in capsys.readouterr().err
