"""NYU Depth V2 and SUN RGB-D from files in their formats: what is cut is what was placed there."""

import shutil

import cv2
import numpy as np
import pytest

from qs3.datasets import nyuv2 as reader
from qs3.datasets.sunrgbd import millimetres
from qs3.errors import ConfigError, Qs3Error
from qs3.store.meta import is_finished, read_manifest
from tests.composing import compose_domain
from tests.fixtures.frame_files import write_nyuv2, write_sunrgbd

NYU = {  # frame, name: class and tier; what is not here is refused or of no class
    (1, "chair"): ("chair", "clean"),
    (1, "night stand"): ("cabinet", "clean"),
    (2, "sofa"): ("sofa", "hard"),
    (3, "chair"): ("chair", "hard"),
    (4, "chair"): ("chair", "clean"),
    (5, "desk"): ("table", "clean"),
    (5, "television"): ("monitor", "clean"),
    (6, "bookshelf"): ("bookshelf", "clean"),
    (7, "lamp"): ("lamp", "hard"),
    (7, "plant"): ("plant", "clean"),
}
SUN = {
    (1, "chair", "chair"), (1, "night_stand", "cabinet"), (4, "chair", "chair"),
    (5, "desk", "table"), (5, "tv", "monitor"), (6, "bookshelf", "bookshelf"),
}  # fmt: skip


def opened(name, root, **more):
    """The domain, its clouds, and all rows of its manifest."""
    domain = compose_domain(name, {"paths.data_dir": str(root), **more})
    data = domain.open()
    return domain, data, read_manifest(domain.folder)


@pytest.fixture(scope="module")
def of_nyuv2(nyuv2):
    return opened("nyuv2", nyuv2)


@pytest.fixture(scope="module")
def of_sunrgbd(sunrgbd):
    return opened("sunrgbd", sunrgbd)


def frame_of(row):
    return int(row.more["frame"])


def test_instances_are_what_was_placed(of_nyuv2, shots):
    _, data, rows = of_nyuv2
    kept = [row for row in rows if row.status == "ok"]
    found = {(frame_of(row), row.more["sub"]): (row.cls, row.more["tier"]) for row in kept}
    assert found == NYU
    assert len(kept) == len(NYU) + 1  # the fourth frame has two chairs
    for row, cloud in zip(kept, data.points, strict=True):
        shot = shots[frame_of(row) - 1]
        assert row.split == shot.split
        where = shot.to_world(np.asarray(cloud, dtype=float))
        names = {row.more["sub"], *(["books"] if row.cls == "bookshelf" else [])}
        things = [thing for thing in shot.things if thing.name in names]
        far = np.min([thing.distance(where) for thing in things], axis=0)
        assert far.max() < 0.08, row.id  # about half a degree of the fitted vertical, and noise
        assert np.median(far) < 0.012, row.id
        height = max(t.z + (t.parts[:, 2] + t.parts[:, 5] / 2).max() for t in things)
        if "cut off" not in row.more.get("why", ""):
            assert abs(where[:, 2].max() - height) < 0.06, row.id
    (refused,) = [row for row in rows if row.status != "ok"]
    assert refused.cls == "chair"
    assert "cut off by the picture" in refused.reason or "pixels" in refused.reason


def test_boxes_are_what_was_placed(of_sunrgbd, shots):
    _, data, rows = of_sunrgbd
    kept = [row for row in rows if row.status == "ok"]
    found = {(frame_of(row), row.more["sub"], row.cls) for row in kept}
    assert found >= SUN
    assert not any("toy" in name or "books" in name for _, name, _ in found if name != "bookshelf")
    for row, cloud in zip(kept, data.points, strict=True):
        shot = shots[frame_of(row) - 1]
        assert (row.split, row.more["sensor"]) == (shot.split, shot.sensor)
        where = shot.to_world(np.asarray(cloud, dtype=float))
        assert where[:, 2].min() > 0.015, row.id  # no floor
        off = np.min([thing.distance(where) for thing in shot.things], axis=0)
        assert off.max() < 0.06, row.id
        assert np.median(off) < 0.01, row.id


@pytest.mark.parametrize("name", ["nyuv2", "sunrgbd"])
def test_without_noise_every_point_is_exact(tmp_path, shots, name):
    """A camera that is a pixel off would move edges by 5 mm, a vertical by half a degree 2 cm."""
    some = [shots[0], shots[3]]
    write = write_nyuv2 if name == "nyuv2" else write_sunrgbd
    write(tmp_path / "published" / name, some, noisy=False)
    _, data, rows = opened(name, tmp_path)
    assert len(data) == 4
    for row, cloud in zip(rows, data.points, strict=True):
        shot = some[frame_of(row) - 1]
        where = shot.to_world(np.asarray(cloud, dtype=float))
        off = np.min([thing.distance(where) for thing in shot.things], axis=0)
        assert off.max() < 1.5e-3, row.id  # depths of SUN RGB-D are whole millimetres


def test_rooms_are_clusters_and_the_vertical_is_noted(of_nyuv2):
    domain, _, rows = of_nyuv2
    importer = domain.importer()
    rooms = {frame_of(row): importer.object_of(row.id) for row in rows}
    assert rooms[1] == rooms[2] == "kitchen_0001"  # recordings a and b
    assert rooms[3] == rooms[4] == "office_0002"
    assert rooms[6] == rooms[7] == "study_0004"
    ways = {frame_of(row): row.more["vertical"] for row in rows}
    assert {ways[frame] for frame in range(1, 7)} == {"floor"}
    assert ways[7] == "planes"  # no floor


def test_an_interrupted_import_goes_on_and_other_settings_begin_anew(
    of_nyuv2, nyuv2, tmp_path, monkeypatch, caplog
):
    keys = {"paths.data_dir": str(nyuv2), "path": str(tmp_path / "store")}
    reads, armed, depth_m = [], [True], reader.LabelledFrames.depth_m

    def stops(self, frame):
        reads.append(frame)
        if armed and reads.count(3) == 2:  # once for its floor, then to be cut
            raise KeyboardInterrupt
        return depth_m(self, frame)

    monkeypatch.setattr(reader.LabelledFrames, "depth_m", stops)
    with pytest.raises(KeyboardInterrupt):
        compose_domain("nyuv2", keys).open()
    parts = tmp_path / ".store.parts"
    assert len(list((parts / "parts").glob("*.npz"))) == 3
    assert not is_finished(tmp_path / "store")
    shutil.copytree(parts, tmp_path / ".other.parts")
    reads.clear()
    armed.clear()
    data = compose_domain("nyuv2", keys).open()
    assert reads.count(0) == 1  # its floor; it was cut before
    assert data.sha256 == of_nyuv2[1].sha256
    reads.clear()
    other = {**keys, "path": str(tmp_path / "other"), "published.tiers": "[clean]"}
    with caplog.at_level("INFO"):
        assert len(compose_domain("nyuv2", other).open()) == 8
    assert reads.count(0) == 2
    assert "are cut anew" in caplog.text


def test_sensors_and_splits(of_sunrgbd, sunrgbd, tmp_path):
    _, data, rows = of_sunrgbd
    assert {row.more["sensor"] for row in rows} == {"kv1", "kv2", "xtion", "realsense"}
    assert {row.split for row in rows} == {"train", "test"}
    more = {"path": str(tmp_path / "kv2"), "published.sensors": "[kv2]"}
    only, few, of_kv2 = opened("sunrgbd", sunrgbd, **more)
    assert {row.more["sensor"] for row in of_kv2} == {"kv2"}
    kv2 = [row.index for row in rows if row.more["sensor"] == "kv2" and row.status == "ok"]
    np.testing.assert_array_equal(few.points, data.points[kv2])
    assert only.importer().object_of(few.ids[0]) == "kv2_block00000"


def test_bits_are_rotated():
    depth = np.array([[0, 1, 2500, 8191, 8192, 65535]], dtype=np.uint16)
    stored = (depth << 3) | (depth >> 13)
    np.testing.assert_array_equal(millimetres(stored), depth)


@pytest.mark.parametrize(
    "override",
    [
        {"published.names": "{chair: throne}"},
        {"published.tiers": "[good]"},
        {"published.rules.erode_px": "-1"},
    ],
)
def test_wrong_settings(nyuv2, tmp_path, override):
    keys = {"paths.data_dir": str(nyuv2), "path": str(tmp_path / "wrong"), **override}
    domain = compose_domain("nyuv2", keys)
    with pytest.raises(ConfigError):
        domain.open()


@pytest.mark.slow
def test_the_raw_depth_is_taken(sunrgbd, tmp_path):
    """Frames whose filled depth is gone are cut as before; without the raw one they are not."""
    shutil.copytree(sunrgbd / "published", tmp_path / "published")
    at = tmp_path / "published" / "sunrgbd" / "SUNRGBD"
    for path in at.rglob("depth_bfx/*.png"):
        path.unlink()
    first = sorted(at.rglob("depth/*.png"))[0]
    whole = first.read_bytes()
    grey = cv2.imencode(".png", np.zeros((20, 20), np.uint8))[1].tobytes()
    for content in (whole[: len(whole) // 2], grey, None):
        if content is None:
            first.unlink()
        else:
            first.write_bytes(content)
        with pytest.raises(Qs3Error):
            opened("sunrgbd", tmp_path)
        assert not is_finished(tmp_path / "sunrgbd")
    _, _, rows = opened("sunrgbd", tmp_path, **{"published.on_error": "skip"})
    (lost,) = [row for row in rows if not row.cls]
    assert str(first.parent) in lost.reason
