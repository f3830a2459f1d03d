"""The core on real frames of a Kinect v1: boxes and cups on a table, labelled pixel by pixel."""

from pathlib import Path

import numpy as np
import pytest
from pypcd4 import PointCloud

from qs3.datasets.clouds import read_pcd
from qs3.datasets.cutting import cut
from qs3.datasets.depth_images import DepthImage, Pinhole, upright
from qs3.datasets.pointed import point_out
from qs3.datasets.regions import Limits, Rules
from qs3.datasets.vertical import angle_deg, floor_up, planes_up

FRAMES = [
    path
    for base in Path(__file__).parents
    for path in sorted((base / "shared" / "data" / "kinect_v1").glob("*.pcd"))
]
CAMERA = Pinhole(525, 525, 319.5, 239.5)  # what the clouds were made with
TABLE = 1
RULES = Rules(limits={"default": Limits(pixels=1000, least_m=0.03, most_m=1.0)})


@pytest.mark.slow
@pytest.mark.skipif(not FRAMES, reason="shared/data/kinect_v1 is not at hand")
def test_two_ways_to_the_vertical_agree_and_objects_stand_on_the_table():
    sizes = []
    for path in FRAMES:
        depth = np.nan_to_num(read_pcd(path)[..., 2])
        label = PointCloud.from_path(path).numpy(("label",)).reshape(depth.shape)
        up, by_planes = floor_up(depth, CAMERA, label == TABLE), planes_up(depth, CAMERA)
        assert angle_deg(up, by_planes) < 1.0, path.name
        image = DepthImage(depth, CAMERA, upright(up))
        measured = read_pcd(path)
        np.testing.assert_allclose(
            image.points_m[depth > 0] @ upright(up), measured[depth > 0], atol=2e-3
        )
        table = np.median(image.points_m[label == TABLE][:, 2])
        for number in np.unique(label[label > TABLE]):
            piece = cut(image, label == number, "box", RULES)
            if piece.refused:
                continue
            low, high = piece.points_m[piece.inlier][:, 2].min(), piece.points_m[:, 2].max()
            assert -0.02 < low - table < 0.08, path.name  # of some the foot is hidden
            assert 0.03 < high - table < 0.4
            sizes.append(max(piece.extent_m))
    assert len(sizes) > 10
    assert 0.1 < np.median(sizes) < 0.3


@pytest.mark.slow
@pytest.mark.skipif(not FRAMES, reason="shared/data/kinect_v1 is not at hand")
def test_what_lies_in_a_box_is_what_was_labelled():
    """Where two things touch, a box cannot part them; most it can."""
    shares = []
    for path in FRAMES[:3]:
        depth = np.nan_to_num(read_pcd(path)[..., 2])
        label = PointCloud.from_path(path).numpy(("label",)).reshape(depth.shape)
        for number in np.unique(label[label > TABLE]):
            own = label == number
            v, u = np.nonzero(own)
            if len(v) < 1000:
                continue
            (one,) = point_out(depth, CAMERA, box=(u.min(), v.min(), u.max() + 1, v.max() + 1))
            assert one.up == "planes"
            found, own = one.mask & (depth > 0), own & (depth > 0)
            shares.append((found & own).sum() / (found | own).sum())
    assert len(shares) >= 6
    assert np.median(shares) > 0.8
