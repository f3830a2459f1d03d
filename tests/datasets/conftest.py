"""Rooms of which everything is known, rendered and written once."""

from dataclasses import replace

import pytest

from tests.composing import compose_domain
from tests.datasets.rooms import poses, record, room, write_lists, write_scene
from tests.fixtures.frame_files import SMALL, Shot, Thing, write_nyuv2, write_sunrgbd

BOOKS = ((0, 0.02, 0.62, 0.5, 0.2, 0.2), (0.1, 0.02, 1.12, 0.5, 0.2, 0.2))
LOST = (3, 8)


@pytest.fixture(scope="session")
def rules():
    """Those of conf/cutting/raw.yaml."""
    return compose_domain("nyuv2", {}).importer().rules


@pytest.fixture(scope="session")
def shots():
    """Clean, covered, cut off, beside a hole, twice in a frame, finer names, tilted cameras."""
    return [
        Shot(
            [Thing("chair", -0.5, 2.4, 35), Thing("night stand", 0.8, 2.6, 25, 0.8)],
            pitch_deg=14, roll_deg=3, scene="kitchen_0001a",
        ),
        Shot(  # a box of no class stands before the sofa
            [
                Thing("sofa", 0.0, 3.2, 25, 0.8),
                Thing("toy", 0.05, 1.9, boxes=((0, 0, 0.3, 0.5, 0.3, 0.6),)),
            ],
            scene="kitchen_0001b",
        ),
        Shot(  # the chair on the left is cut off a little, the one on the right nearly lost
            [Thing("chair", -1.02, 2.2, 40), Thing("chair", 1.45, 2.2, 20)],
            pitch_deg=12, scene="office_0002",
        ),
        Shot(  # two of one name
            [Thing("chair", -0.7, 2.5, 30), Thing("chair", 0.6, 2.7, -30)],
            roll_deg=-4, pitch_deg=18, scene="office_0002", sensor="kv2",
        ),
        Shot(
            [Thing("desk", -0.5, 3.0, 15, 0.7), Thing("television", 0.8, 2.6, 20, 1.2, z=0.5)],
            pitch_deg=9, scene="study_0003", split="test", sensor="xtion",
        ),
        Shot(  # books are labelled apart from their shelf
            [
                Thing("bookshelf", 0, 2.9, 20, 0.8),
                Thing("books", 0, 2.9, 20, 0.8, boxes=BOOKS),
            ],
            scene="study_0004", split="test", sensor="realsense", pitch_deg=10,
        ),
        Shot([Thing("lamp", 0.1, 2.2, 0), Thing("plant", -0.8, 2.2, 0)], floor=False,
             pitch_deg=20, roll_deg=2, scene="study_0004", split="test", sensor="kv1"),
    ]  # fmt: skip


@pytest.fixture(scope="session")
def nyuv2(shots, tmp_path_factory):
    """A data folder with published/nyuv2."""
    root = tmp_path_factory.mktemp("nyuv2")
    write_nyuv2(root / "published" / "nyuv2", shots)
    return root


@pytest.fixture(scope="session")
def sunrgbd(shots, tmp_path_factory):
    """A data folder with published/sunrgbd."""
    root = tmp_path_factory.mktemp("sunrgbd")
    small = [replace(shot, **SMALL, rendered=()) for shot in shots]
    write_sunrgbd(root / "published" / "sunrgbd", small)
    return root


@pytest.fixture(scope="session")
def recorded():
    """Two rooms by scene: the room, its recording and its masks."""
    from qs3.sensors.renderers.mitsuba import MitsubaRenderer

    renderer = MitsubaRenderer(samples=1)
    rooms = {"scene0001_00": room(), "scene0007_01": room(chair=1)}
    return {
        scene: (made, *record(made, poses(11), renderer, lost=LOST))
        for scene, made in rooms.items()
    }


@pytest.fixture(scope="session")
def written(recorded, tmp_path_factory):
    """A folder as ScanNet's: one scene of train, one of val, one of neither list."""
    root = tmp_path_factory.mktemp("scannet")
    for scene, made in recorded.items():
        write_scene(root / "scans", scene, *made)
    write_scene(root / "scans", "scene0100_00", *recorded["scene0001_00"])
    write_lists(root, ["scene0001_00", "scene0500_00"], ["scene0007_01"])
    return root
