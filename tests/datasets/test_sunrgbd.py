"""SUN RGB-D from an archive in its format: boxes less the floor, four sensors, damaged entries."""

import shutil

import cv2
import numpy as np
import pytest

from qs3.datasets.sunrgbd import millimetres
from qs3.errors import Qs3Error
from qs3.store.meta import is_finished, read_manifest
from tests.composing import compose_domain
from tests.fixtures.frame_files import write_sunrgbd


@pytest.fixture(scope="module")
def opened(sunrgbd):
    domain = compose_domain("sunrgbd", {"paths.data_dir": str(sunrgbd)})
    data = domain.open()
    return domain, data, read_manifest(domain.folder, data.classes)


def test_what_is_cut_is_what_was_placed(opened, shots):
    _, data, rows = opened
    kept = [row for row in rows if row.status == "ok"]
    found = {(int(row.more["frame"]), row.more["sub"], row.cls) for row in kept}
    assert {
        (1, "chair", "chair"), (1, "night_stand", "cabinet"), (4, "chair", "chair"),
        (5, "desk", "table"), (5, "tv", "monitor"), (6, "bookshelf", "bookshelf"),
    } <= found  # fmt: skip
    assert not any("toy" in name or "books" in name for _, name, _ in found if name != "bookshelf")
    for row, cloud in zip(kept, data.points, strict=True):
        shot = shots[int(row.more["frame"]) - 1]
        assert (row.split, row.more["sensor"]) == (shot.split, shot.sensor)
        where = shot.to_world(np.asarray(cloud, dtype=float))
        assert where[:, 2].min() > 0.015, row.id  # no floor
        off = np.min([thing.distance(where) for thing in shot.things], axis=0)
        assert off.max() < 0.06, row.id
        assert np.median(off) < 0.01, row.id


def test_without_noise_every_point_is_exact(tmp_path, shots):
    """A camera that is a pixel off would move edges by 5 mm; a depth is a whole millimetre."""
    write_sunrgbd(tmp_path / "published" / "sunrgbd", [shots[0], shots[3]], noisy=False)
    domain = compose_domain("sunrgbd", {"paths.data_dir": str(tmp_path)})
    data = domain.open()
    assert len(data) == 4
    for row, cloud in zip(read_manifest(domain.folder, data.classes), data.points, strict=True):
        shot = (shots[0], shots[3])[int(row.more["frame"]) - 1]
        where = shot.to_world(np.asarray(cloud, dtype=float))
        off = np.min([thing.distance(where) for thing in shot.things], axis=0)
        assert off.max() < 1.5e-3, row.id


def test_sensors_and_splits(opened, sunrgbd, tmp_path, shots):
    _, data, rows = opened
    assert {row.more["sensor"] for row in rows} == {"kv1", "kv2", "xtion", "realsense"}
    assert {row.split for row in rows} == {"train", "test"}
    keys = {"paths.data_dir": str(sunrgbd), "path": str(tmp_path / "kv2")}
    only = compose_domain("sunrgbd", {**keys, "published.sensors": "[kv2]"})
    few = only.open()
    assert {row.more["sensor"] for row in read_manifest(only.folder, few.classes)} == {"kv2"}
    kv2 = [row.index for row in rows if row.more["sensor"] == "kv2" and row.status == "ok"]
    np.testing.assert_array_equal(few.points, data.points[kv2])
    assert only.importer().object_of(few.ids[0]) == "kv2_block00000"
    with pytest.raises(Qs3Error):
        compose_domain("sunrgbd", {**keys, "published.sensors": "[kv9]"}).open()


def test_bits_are_rotated():
    depth = np.array([[0, 1, 2500, 8191, 8192, 65535]], dtype=np.uint16)
    stored = (depth << 3) | (depth >> 13)
    np.testing.assert_array_equal(millimetres(stored), depth)


@pytest.fixture
def copy(sunrgbd, tmp_path):
    shutil.copytree(sunrgbd / "published", tmp_path / "published")
    return tmp_path


def refused(root):
    with pytest.raises(Qs3Error):
        compose_domain("sunrgbd", {"paths.data_dir": str(root)}).open()
    assert not is_finished(root / "sunrgbd")


@pytest.mark.slow
def test_the_raw_depth_is_taken(copy):
    """Frames whose filled depth is gone are cut as before; without the raw one they are not."""
    at = copy / "published" / "sunrgbd" / "SUNRGBD"
    for path in at.rglob("depth_bfx/*.png"):
        path.unlink()
    first = sorted(at.rglob("depth/*.png"))[0]
    whole = first.read_bytes()
    first.write_bytes(whole[: len(whole) // 2])
    refused(copy)
    first.write_bytes(cv2.imencode(".png", np.zeros((20, 20), np.uint8))[1].tobytes())
    refused(copy)
    first.rename(copy / "elsewhere.png")
    refused(copy)
    skipping = {"paths.data_dir": str(copy), "published.on_error": "skip"}
    domain = compose_domain("sunrgbd", skipping)
    data = domain.open()
    (lost,) = [row for row in read_manifest(domain.folder, data.classes) if not row.cls]
    assert str(first.parent) in lost.reason
