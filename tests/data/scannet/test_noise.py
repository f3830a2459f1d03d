"""A noisy sensor: the clouds lie on their objects within its noise."""

import numpy as np
import pytest

from qs3.data.scannet.extraction import extract
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.data.scannet.rooms import (
    COLOUR,
    COLOUR_FROM_DEPTH,
    distances,
    poses,
    record,
    room,
    write_lists,
    write_scene,
)

SENSOR = ReferenceSpeckle()
CHAIR = 2
SCENE = "scene0001_00"


class Kinect:
    """Looks at the chair; notes its errors on it, and what the depth should have been."""

    def __init__(self):
        self.errors, self.frames = [], []

    def __call__(self, the_room, pose, renderer, camera):
        box = the_room.bodies[CHAIR].mesh.bounds
        rng = np.random.default_rng(len(self.frames))
        frame = SENSOR.scan(tuple(the_room.bodies.values()), box, pose, renderer, rng)
        error = (frame.depth_m - frame.clean_m)[(frame.label == CHAIR + 1)]
        self.errors.append(np.abs(error[np.isfinite(error)]))
        self.frames.append(frame)
        height, width = frame.depth_m.shape
        whole = np.zeros((camera.height_px, camera.width_px))
        window = slice(frame.top, frame.top + height), slice(frame.left, frame.left + width)
        whole[window] = np.nan_to_num(frame.depth_m)
        return whole


def allowed_m(depth_m):
    """How far ScanNet's masks let the measured depth be from the reconstruction's.

    Its ProjectAnnotations takes the labels away from where they differ by more than 0.2 m and 1 %.
    """
    return 0.2 + 0.01 * depth_m


def filtered(masks, frames):
    """The masks as ScanNet would have published them, for this sensor's errors."""
    for index, frame in enumerate(frames):
        measured = np.nan_to_num(frame.depth_m)
        off = (measured > 0) & (np.abs(measured - frame.clean_m) > allowed_m(measured))
        points = frame.points(np.where(off, measured, np.nan), COLOUR_FROM_DEPTH)
        u = np.rint(COLOUR.focal_px * points[:, 0] / points[:, 2] + COLOUR.cx_px).astype(int)
        v = np.rint(COLOUR.focal_px * points[:, 1] / points[:, 2] + COLOUR.cy_px).astype(int)
        inside = (u >= 0) & (v >= 0) & (u < COLOUR.width_px) & (v < COLOUR.height_px)
        masks[index][v[inside], u[inside]] = 0
    return masks


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """The room, the sensor's errors on the chair, and its cloud under two kinds of masks."""
    made, kinect = room(), Kinect()
    renderer = MitsubaRenderer(samples=4)
    recording, masks = record(made, poses(8), renderer, camera=SENSOR.intrinsics, depth=kinect)
    clouds = {}
    for kind in ("plain", "published"):
        root = tmp_path_factory.mktemp(kind)
        if kind == "published":
            masks = filtered(masks, kinect.frames)
        write_scene(root / "scans", SCENE, made, recording, masks)
        write_lists(root, [SCENE], ["scene0002_00"])
        pointset = extract(
            scans=root / "scans", labels=root / "labels.tsv", train=root / "train.txt",
            val=root / "val.txt", out=root / "out", workers=0,
        )  # fmt: skip
        clouds[kind] = pointset.points[pointset.ids.index(f"chair/train/{SCENE}_{CHAIR}")]
    errors = np.concatenate(kinect.errors)
    off = {kind: distances(cloud, made.bodies[CHAIR].mesh) for kind, cloud in clouds.items()}
    return errors, off


def test_the_cloud_lies_on_the_chair_within_the_noise(noisy):
    """The distance from the surface is at most the error along the ray, at the same quantile.

    Farthest point sampling prefers what sticks out, so higher quantiles are given a half more.
    """
    errors, off = noisy
    usual = errors[errors < allowed_m(3.0)]
    for share, slack in ((0.5, 1.0), (0.68, 1.0), (0.9, 1.5), (0.95, 1.5)):
        assert np.quantile(off["published"], share) < slack * np.quantile(usual, share), share
    assert off["published"].max() < allowed_m(4.0)
    # and it is a noisy sensor's cloud, not the clean one
    assert np.median(off["published"]) > 0.3 * np.median(usual)


def test_gross_errors_of_the_sensor_stay_where_the_masks_let_them(noisy):
    """Nothing is cleaned: a mask that knows nothing of depth keeps the sensor's outliers."""
    errors, off = noisy
    assert np.quantile(off["plain"], 0.68) < np.quantile(errors, 0.68) * 1.2
    assert off["plain"].max() > 0.5
    assert np.mean(errors > 0.5) > 0.001
