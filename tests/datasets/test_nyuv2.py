"""NYU Depth V2 from a file in its format: what is cut equals what was placed in the rooms."""

import shutil

import numpy as np
import pytest

from qs3.datasets import nyuv2 as reader
from qs3.errors import ConfigError, Qs3Error
from qs3.store.meta import is_finished, read_manifest
from tests.composing import compose_domain
from tests.fixtures.frame_files import write_nyuv2

EXPECTED = {  # frame, name: class and tier; what is not here is refused or of no class
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


@pytest.fixture(scope="module")
def opened(nyuv2):
    """The domain, its clouds, and all rows of its manifest."""
    domain = compose_domain("nyuv2", {"paths.data_dir": str(nyuv2)})
    data = domain.open()
    return domain, data, read_manifest(domain.folder, data.classes)


def test_what_is_cut_is_what_was_placed(opened, shots):
    _, data, rows = opened
    kept = [row for row in rows if row.status == "ok"]
    found = {(int(row.more["frame"]), row.more["sub"]): (row.cls, row.more["tier"]) for row in kept}
    assert found == EXPECTED
    assert len(kept) == len(EXPECTED) + 1  # the fourth frame has two chairs
    for row, cloud in zip(kept, data.points, strict=True):
        shot = shots[int(row.more["frame"]) - 1]
        assert row.split == shot.split
        where = shot.to_world(np.asarray(cloud, dtype=float))
        things = [thing for thing in shot.things if thing.name == row.more["sub"]]
        if row.cls == "bookshelf":  # with its books
            things = [*things, *(thing for thing in shot.things if thing.name == "books")]
        far = np.min([thing.distance(where) for thing in things], axis=0)
        assert far.max() < 0.08, row.id  # about half a degree of the fitted vertical, and noise
        assert np.median(far) < 0.012, row.id
        height = max(t.z + (t.parts[:, 2] + t.parts[:, 5] / 2).max() for t in things)
        if "cut off" not in row.more.get("why", ""):
            assert abs(where[:, 2].max() - height) < 0.06, row.id
    (refused,) = [row for row in rows if row.status != "ok"]
    assert refused.cls == "chair"
    assert "cut off by the picture" in refused.reason or "pixels" in refused.reason


def test_without_noise_every_point_is_exact(tmp_path, shots):
    """A camera that is a pixel off would move edges by 5 mm, a vertical by half a degree 2 cm."""
    some = [shots[0], shots[3]]
    write_nyuv2(tmp_path / "published" / "nyuv2", some, noisy=False)
    domain = compose_domain("nyuv2", {"paths.data_dir": str(tmp_path)})
    data = domain.open()
    assert len(data) == 4
    for row, cloud in zip(read_manifest(domain.folder, data.classes), data.points, strict=True):
        shot = some[int(row.more["frame"]) - 1]
        where = shot.to_world(np.asarray(cloud, dtype=float))
        off = np.min([thing.distance(where) for thing in shot.things], axis=0)
        assert off.max() < 1e-3, row.id


def test_rooms_are_clusters_and_the_vertical_is_told(opened):
    domain, _, rows = opened
    importer = domain.importer()
    rooms = {int(row.more["frame"]): importer.object_of(row.id) for row in rows}
    assert rooms[1] == rooms[2] == "kitchen_0001"  # recordings a and b
    assert rooms[3] == rooms[4] == "office_0002"
    assert rooms[6] == rooms[7] == "study_0004"
    ways = {int(row.more["frame"]): row.more["vertical"] for row in rows}
    assert {ways[frame] for frame in range(1, 7)} == {"floor"}
    assert ways[7] == "planes"  # no floor, and too few floors to trust the accelerometer


def test_an_interrupted_import_goes_on(opened, nyuv2, tmp_path, monkeypatch):
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
    assert len(list((tmp_path / ".store.parts" / "parts").glob("*.npz"))) == 3
    assert not is_finished(tmp_path / "store")
    reads.clear()
    armed.clear()
    data = compose_domain("nyuv2", keys).open()
    monkeypatch.undo()
    assert reads.count(0) == 1  # its floor; it was cut before
    assert data.sha256 == opened[1].sha256


@pytest.mark.slow
def test_other_settings_begin_anew(nyuv2, tmp_path, monkeypatch, caplog):
    keys = {"paths.data_dir": str(nyuv2), "path": str(tmp_path / "store")}
    labels = reader.LabelledFrames.labels

    def stops(self, frame):
        if frame == 6 and list(work.glob("*.npz")):
            raise KeyboardInterrupt
        return labels(self, frame)

    work = tmp_path / ".store.parts" / "parts"
    monkeypatch.setattr(reader.LabelledFrames, "labels", stops)
    with pytest.raises(KeyboardInterrupt):
        compose_domain("nyuv2", keys).open()
    monkeypatch.undo()
    other = {**keys, "published.tiers": "[clean]"}
    with caplog.at_level("INFO"):
        data = compose_domain("nyuv2", other).open()
    assert "are cut anew" in caplog.text
    assert len(data) == 8


@pytest.fixture
def copy(nyuv2, tmp_path):
    shutil.copytree(nyuv2 / "published", tmp_path / "published")
    return tmp_path


def refused(root):
    keys = {"paths.data_dir": str(root)}
    with pytest.raises(Qs3Error):
        compose_domain("nyuv2", keys).open()
    assert not is_finished(root / "nyuv2")


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
