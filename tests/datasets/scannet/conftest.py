"""Rooms rendered and written once."""

import pytest

from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.datasets.scannet.rooms import poses, record, room, write_lists, write_scene

LOST = (3, 8)


@pytest.fixture(scope="session")
def renderer():
    return MitsubaRenderer(samples=1)


@pytest.fixture(scope="session")
def recorded(renderer):
    """Two rooms by scene: the room, its recording and its masks."""
    rooms = {"scene0001_00": room(), "scene0007_01": room(chair=1)}
    return {
        scene: (made, *record(made, poses(14), renderer, lost=LOST))
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
