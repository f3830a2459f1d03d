"""Our own simulated Kinect looks into a room; its frames, written as NYU Depth V2, are cut."""

import numpy as np
import pytest
from trimesh.proximity import closest_point_naive

from qs3.data.store import read_manifest
from qs3.geometry.cameras import look_at
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.composing import compose_domain
from tests.data.scannet.rooms import room
from tests.fixtures.frame_files import Shot, Thing, write_nyuv2

NAMES = {2: "chair", 4: "sofa", 5: "table"}  # objectId in the room -> label
EYES = ((0.4, -3.0, 1.5), (2.2, -2.2, 1.5))
ROOM = np.array([[-3.0, -3, -0.2], [3, 3, 3]])


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    """The room, where its camera stood, the domain, clouds and rows."""
    the_room, sensor, shots, poses = room(), ReferenceSpeckle(), [], []
    for index, eye in enumerate(EYES):
        pose = look_at(np.array(eye), np.array([0.3, 0.5, 0.3]))
        frame = sensor.scan(
            tuple(the_room.bodies.values()), ROOM, pose, MitsubaRenderer(samples=4),
            np.random.default_rng(index),
        )  # fmt: skip
        assert (frame.left, frame.top, frame.step_px) == (0, 0, 1)
        shown = np.full(frame.label.shape, -2, dtype=np.int64)
        shown[frame.label == 1] = -1  # the floor
        for place, number in enumerate(NAMES):
            shown[frame.label == number + 1] = place
        things = [Thing(name, 0, 0) for name in NAMES.values()]
        depth = np.nan_to_num(frame.depth_m).astype(float)
        shots.append(Shot(things, scene=f"made_{index:04d}", rendered=(depth, shown)))
        poses.append(pose)
    root = tmp_path_factory.mktemp("ours")
    write_nyuv2(root / "published" / "nyuv2", shots, noisy=False, cut_area=False)
    k = frame.camera.intrinsics
    camera = f"{{fx_px: {k.focal_px}, fy_px: {k.focal_px}, cx_px: {k.cx_px}, cy_px: {k.cy_px}}}"
    domain = compose_domain("nyuv2", {"paths.data_dir": str(root), "published.camera": camera})
    data = domain.open()
    return the_room, poses, data, read_manifest(domain.folder, data.classes)


def test_clouds_lie_on_what_the_sensor_saw(cut):
    the_room, poses, data, rows = cut
    kept = [row for row in rows if row.status == "ok"]
    assert {row.more["sub"] for row in kept} >= {"chair", "sofa"}
    assert {row.more["vertical"] for row in kept} == {"floor"}
    bodies = {name: the_room.bodies[number].mesh for number, name in NAMES.items()}
    for row in kept:
        pose = poses[int(row.more["frame"]) - 1]
        forward = pose[:2, 2] / np.linalg.norm(pose[:2, 2])
        turn = np.array([[forward[1], forward[0], 0], [-forward[0], forward[1], 0], [0, 0, 1]])
        where = np.asarray(data.points[row.index][::8], dtype=float) @ turn.T + pose[:3, 3]
        off = closest_point_naive(bodies[row.more["sub"]].to_trimesh(), where)[1]
        assert np.median(off) < 0.02, row.id
        assert np.quantile(off, 0.95) < 0.12, row.id  # fringes at its edges are the sensor's own
        assert where[:, 2].min() > -0.1
