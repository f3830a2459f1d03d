"""`qs3.sense` and `qs3.match`: noise by seed alone, on any grid, as of the rendered sensor."""

import cv2
import numpy as np
import pytest
from PIL import Image

import qs3
from qs3.config.compose import composed
from qs3.datasets.depth_images import Pinhole
from qs3.errors import ConfigError, DataError
from qs3.generation.rooms import _Shelf
from qs3.generation.scan import Scanner
from qs3.generation.sense import device, frame_of, seen_by
from qs3.sensors.optics.visibility import Reason
from qs3.sensors.renderers.base import Body
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from qs3.utils.seeding import object_rng
from tests.running import main
from tests.sensors.by_depth import ByDepth, agreement

LENS = (262.5, 262.5, 159.5, 119.5)
PRESETS = (
    "kinect_v1", "structure_sensor", "realsense_d435", "speckle_stereo_small", "time_of_flight",
    "fringe", "kinect_like", "kinect_v1_depth", "blensor_kinect", "blensor_tof",
    pytest.param("realsense_d415", marks=pytest.mark.slow),  # 1280 x 720 px, 128 disparities
)  # fmt: skip


def box_before_a_wall(near=1.2, far=2.0, height=240, width=320):
    depth = np.full((height, width), far)
    depth[height // 3 : -height // 3, width // 3 : -width // 3] = near
    return depth


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_measures_a_box_before_a_wall(name):
    depth = box_before_a_wall()
    noisy, why = qs3.sense(depth, LENS, sensor=name, explain=True)
    assert (noisy.shape, noisy.dtype, why.dtype) == (depth.shape, np.float32, np.uint8)
    measured = np.isfinite(noisy)
    np.testing.assert_array_equal(measured, why == Reason.OK)
    seen = why != Reason.OUTSIDE
    assert measured[seen].mean() > 0.8
    assert np.median(np.abs(noisy - depth)[measured]) < 0.02
    assert np.isfinite(qs3.sense(depth, LENS, sensor=name)).sum() == measured.sum()
    if hasattr(device(name), "tan_half_width"):  # it throws a pattern
        assert 0.002 < (why == Reason.SHADOW).mean() + (why == Reason.OCCLUDED).mean() < 0.1


def test_noise_comes_from_the_seed_alone():
    frames = np.stack([box_before_a_wall(1.2 + 0.1 * k) for k in range(3)])
    grey = np.linspace(0.2, 0.9, 320)
    found = qs3.sense(frames, LENS, sensor="kinect_v1", seed=5, albedo=grey)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        again = qs3.sense(frames[:1], LENS, sensor="kinect_v1", seed=(5,), albedo=grey)
    finally:
        cv2.setNumThreads(threads)
    np.testing.assert_array_equal(found[0], again[0])
    np.testing.assert_array_equal(found, qs3.sense(frames, LENS, sensor="kinect_v1", seed=5,
                                                   albedo=grey))  # fmt: skip
    other = qs3.sense(frames[0], LENS, sensor="kinect_v1", seed=6, albedo=grey)
    assert (np.nan_to_num(other) != np.nan_to_num(found[0])).mean() > 0.1


def test_each_pixel_has_the_value_of_the_device_s_nearest():
    sensor = device("speckle_stereo_small")  # every second of 540 x 540 pixels
    frame = frame_of(box_before_a_wall(), Pinhole(*LENS), sensor, (0, 0))
    k = frame.camera.intrinsics
    own = Pinhole(*(k.focal_px / 2,) * 2, (k.cx_px - frame.left) / 2, (k.cy_px - frame.top) / 2)
    depth, why = seen_by(frame, own, (270, 270))
    np.testing.assert_array_equal(depth, frame.depth_m)
    np.testing.assert_array_equal(why, frame.reason)
    wide = Pinhole(100.0, 100.0, 99.5, 99.5)  # of a larger view than the device's
    depth, why = seen_by(frame, wide, (200, 200))
    assert (why[:, :60] == Reason.OUTSIDE).all()
    assert np.isnan(depth[:, :60]).all()
    assert (why[70:130, 70:130] != Reason.OUTSIDE).all()


def test_dark_surfaces_and_strong_light_cost_depth():
    depth = box_before_a_wall(2.0, 3.0)
    grey = np.where(np.arange(320) < 160, 0.002, 0.8)
    share = {}
    for light in (0.0, 2000.0):
        noisy = qs3.sense(depth, LENS, sensor="realsense_d435", albedo=grey, ambient=light)
        share[light] = np.isfinite(noisy[:, :150]).mean(), np.isfinite(noisy[:, 170:]).mean()
    assert share[0.0][1] > 0.95 > share[0.0][0] + 0.2
    assert share[2000.0][1] < 0.5


def test_a_pair_is_matched_as_the_device_matches_its_own():
    sensor = device("realsense_d435")
    k = sensor.intrinsics
    lens = Pinhole(k.focal_px, k.focal_px, k.cx_px, k.cy_px)
    frame = frame_of(box_before_a_wall(height=480, width=848), lens, sensor, (0, 0))
    depth, why = qs3.match(frame.images["left"], frame.images["right"], lens,
                           baseline_m=sensor.baseline_m, explain=True)  # fmt: skip
    inner = np.s_[40:-40, 100:-40]
    same = np.isclose(depth, frame.depth_m, rtol=1e-3, equal_nan=True)
    assert same[inner].mean() > 0.97
    np.testing.assert_array_equal(np.isfinite(depth), why == Reason.OK)
    # Twice the baseline: the same disparities are twice as far.
    twice = qs3.match(frame.images["left"], frame.images["right"], lens, baseline_m=0.1)
    both = np.isfinite(depth) & np.isfinite(twice)
    np.testing.assert_allclose(twice[both], 2 * depth[both], rtol=1e-5)
    few = qs3.match(frame.images["left"], frame.images["right"], lens, baseline_m=0.05,
                    num_disparities=13)  # fmt: skip
    assert np.nanmin(few) > 424 * 0.05 / 12 - 0.01


def test_what_cannot_be_is_an_error():
    pair = np.zeros((2, 48, 64), np.uint8)
    with pytest.raises(ConfigError, match="two cameras"):
        qs3.match(*pair, LENS, baseline_m=0.05, preset="kinect_v1")
    with pytest.raises(ConfigError, match="realsense"):
        qs3.sense(box_before_a_wall(), LENS, sensor="realsense")
    with pytest.raises(DataError, match="millimetres"):
        qs3.sense(1000 * box_before_a_wall(), LENS)
    with pytest.raises(DataError, match="resolution"):
        qs3.sense(box_before_a_wall(), (525, 525, 319.5, 239.5))


def test_the_commands_do_the_same(tmp_path, capsys):
    (tmp_path / "in").mkdir()
    depth = np.stack([box_before_a_wall(1.2 + 0.1 * k) for k in range(2)])
    for k, one in enumerate(depth):
        Image.fromarray((one * 1000).astype(np.uint16)).save(tmp_path / "in" / f"{k}.png")
    np.save(tmp_path / "one.npy", depth[0])
    words = [f"intrinsics={','.join(map(str, LENS))}", "sensor=kinect_v1", "seed=3", "explain=true"]
    assert main(["sense", str(tmp_path / "in"), *words, f"out={tmp_path / 'out'}"]) == 0
    one, picture = tmp_path / "noisy.npy", tmp_path / "picture.png"
    more = [f"out={one}", f"picture={picture}"]
    assert main(["sense", str(tmp_path / "one.npy"), *words, *more]) == 0
    assert "noisy.npy" in capsys.readouterr().out
    found, why = qs3.sense(depth[0], LENS, sensor="kinect_v1", seed=(3, 0), explain=True)
    np.testing.assert_array_equal(np.load(one), found)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "noisy_why.png")), why)
    kept = np.asarray(Image.open(tmp_path / "out" / "0.png"))
    np.testing.assert_allclose(kept / 1000, np.nan_to_num(found), atol=6e-4)
    assert (tmp_path / "out" / "1_why.png").is_file()
    assert cv2.imread(str(picture)).shape[1] > 600

    frame = frame_of(depth[0], Pinhole(*LENS), device("realsense_d435"), (0, 0))
    for side in ("left", "right"):
        Image.fromarray(frame.images[side]).save(tmp_path / f"{side}.png")
    words = ["intrinsics=424,424,423.5,239.5", "baseline=0.05", f"out={tmp_path / 'depth.npy'}"]
    assert main(["match", *(str(tmp_path / f"{s}.png") for s in ("left", "right")), *words]) == 0
    wanted = qs3.match(frame.images["left"], frame.images["right"], (424, 424, 423.5, 239.5),
                       baseline_m=0.05)  # fmt: skip
    np.testing.assert_array_equal(np.load(tmp_path / "depth.npy"), wanted)


def rooms(count, lens):
    """Furnished rooms with surfaces of several albedos, and a place to stand in each."""
    recipe = Scanner(composed("generate", "domain=rooms10")).recipe
    for k in range(count):
        rng = object_rng(0, f"room_{k}", 0)
        room = recipe.furnishing.furnish(_Shelf(recipe.shelves["train"], recipe.shares).draw, rng)
        poses = (recipe.camera.before(rng, thing, room, lens) for thing in room.things)
        meshes = (*(thing.mesh for thing in room.things), *room.others, *room.shell)
        bodies = tuple(Body(mesh, albedo=rng.uniform(0.3, 0.9)) for mesh in meshes)
        yield bodies, next(pose for pose in poses if pose is not None)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kinect_v1", "realsense_d435", "time_of_flight"])
def test_rooms_look_as_the_rendered_sensor_sees_them(name):
    """The same noise in both, so that what differs is the images alone."""
    sensor, renderer = device(name), MitsubaRenderer(samples=16)
    box, apart = np.array([[-100.0] * 3, [100.0] * 3]), []
    for k, (bodies, pose) in enumerate(rooms(5, sensor.intrinsics)):
        rendered, found = (
            sensor.scan(bodies, box, pose, one, np.random.default_rng(k), explain=True)
            for one in (renderer, ByDepth(renderer))
        )
        scale = sensor.focal_px * getattr(sensor, "baseline_m", 0.05)
        status, reason, differences = agreement(rendered, found, scale)
        assert min(status, reason) > 0.95, k
        apart.append(differences)
    assert np.median(np.concatenate(apart)) <= 0.1
