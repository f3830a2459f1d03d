"""ScanNet's files: what was written is read."""

import json
import struct

import numpy as np
import pytest

from qs3.classes import CLASSES
from qs3.datasets.scannet_files import (
    INSTANCES,
    LABELS,
    NAMES,
    Labelled,
    MaskArchive,
    SensFile,
    is_rigid,
    read_label_map,
    read_objects,
    read_scene_list,
)
from qs3.errors import DataError
from tests.datasets.writing import (
    LOST,
    Recording,
    intrinsics,
    write_label_map,
    write_zip,
)

SHAPE = (6, 8)


@pytest.fixture
def label_map(tmp_path):
    write_label_map(tmp_path / "labels.tsv")
    return read_label_map(tmp_path / "labels.tsv")


def shifted(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def recording(frames=3, **more):
    rng = np.random.default_rng(0)
    depth = [rng.integers(0, 9000, SHAPE).astype(np.uint16) for _ in range(frames)]
    poses = [shifted(i) for i in range(frames)]
    k = intrinsics(7.5, 7.25, 3.5, 2.5)
    return Recording(depth, poses, k, intrinsics(16, 15, 8, 6), (18, 14), **more)


@pytest.mark.parametrize("compression", [0, 1])
def test_what_was_written_is_read(tmp_path, compression):
    made = recording(compression=compression, base_from_colour=shifted(0.5), shift=500.0)
    made.poses[1] = LOST
    made.write(tmp_path / "a.sens")
    with SensFile(tmp_path / "a.sens") as sens:
        header = sens.header
        assert (header.depth_px, header.colour_px) == (SHAPE[::-1], (18, 14))
        np.testing.assert_array_equal(header.depth_intrinsics, made.k_depth[:3, :3])
        np.testing.assert_array_equal(header.colour_intrinsics, made.k_colour[:3, :3])
        np.testing.assert_allclose(header.colour_from_depth, shifted(-0.5))
        assert [is_rigid(pose) for pose in sens.poses] == [True, False, True]
        np.testing.assert_array_equal(sens.poses[2], made.poses[2])
        for i in (2, 0, 1):  # in any order
            depth = sens.depth_m(i)
            assert depth.dtype == np.float32
            np.testing.assert_allclose(depth, made.depth[i] / 500.0, rtol=1e-6)


def test_a_frame_without_depth_is_empty_and_no_inertial_frames_are_needed(tmp_path):
    made = recording(1)
    sizes = struct.pack("<QQQQ", 0, 0, 0, 0)
    path = tmp_path / "a.sens"
    path.write_bytes(made.header() + np.eye(4, dtype="<f4").tobytes() + sizes)
    with SensFile(path) as sens:
        depth = sens.depth_m(0)
    np.testing.assert_array_equal(depth, np.zeros(SHAPE))


def test_masks_by_the_numbers_of_their_frames(tmp_path):
    rng = np.random.default_rng(0)
    images = {i: rng.integers(0, 9000, SHAPE).astype(np.uint16) for i in (0, 3, 12)}
    write_zip(tmp_path / "a.zip", LABELS, images)
    with MaskArchive(tmp_path / "a.zip", LABELS) as masks:
        assert masks.frames == {0, 3, 12}
        for frame, image in images.items():
            np.testing.assert_array_equal(masks.read(frame), image)
            assert masks.read(frame).dtype == np.uint16
        with pytest.raises(DataError, match="frame 1"):
            masks.read(1)
    with pytest.raises(DataError, match=r"a\.zip"):
        MaskArchive(tmp_path / "a.zip", INSTANCES)


def test_names_are_taken_exactly_after_tidying(label_map):
    renamed = {"shelf": "bookshelf", "couch": "sofa"}
    assert tuple(renamed.get(name, name) for name in NAMES) == CLASSES
    words = label_map.class_of_label
    assert words["chairs"] == "chair"
    assert words["sofa"] == words["couch"] == "sofa"
    assert words["shelf"] == "bookshelf"
    assert "bookshelf" not in words  # PointDA-10 takes "shelf" alone
    assert not {"wall", "box"} & set(words)
    assert label_map.class_of_id[23] == "chair"
    assert 18 not in label_map.class_of_id


def test_objects_of_an_aggregation(tmp_path, label_map):
    """As in scene0217_00, whose list holds objects twice: the same class twice does no harm."""
    groups = [(0, "chair"), (1, "bed"), (0, "chairs"), (1, "table"), (2, "wall"), (3, "couch ")]
    document = {"segGroups": [{"objectId": n, "label": w, "segments": []} for n, w in groups]}
    path = tmp_path / "a.aggregation.json"
    path.write_text(json.dumps(document))
    assert read_objects(path, label_map) == [
        Labelled(0, "chair", "chair"),
        Labelled(3, "couch", "sofa"),
    ]


def test_scene_lists(tmp_path):
    path = tmp_path / "train.txt"
    path.write_text("scene0191_00\r\nscene0191_01\n\n")
    assert read_scene_list(path) == ["scene0191_00", "scene0191_01"]
    path.write_text("scene0191_00\n../etc\n")
    with pytest.raises(DataError):
        read_scene_list(path)
