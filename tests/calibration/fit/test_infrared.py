"""A preset from infrared pictures: what a simulated camera hides is found again."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import yaml
from tests.sensors.fit import simulated_pictures
from tests.sensors.fit.simulated_pictures import BASE, HIDDEN, save, three_walls

from qs3.calibration.bench.cached_renderer import StillRenderer
from qs3.calibration.fit.infrared import FOCAL_BASELINE, NOISE, Pictures, fit_pictures
from qs3.calibration.fit.infrared_statistics import statistics
from qs3.calibration.fit.pictures import read_pictures
from qs3.calibration.fit.stereo_preset import report
from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.optics.patterns import Speckle
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.running import main
from tests.sensors.scenery import POSE, square


@pytest.fixture(scope="module")
def renderer():
    return MitsubaRenderer(samples=16)


@pytest.fixture(scope="module")
def scenes(renderer):
    return three_walls(HIDDEN, renderer)


def test_light_lens_and_noise_are_found_within_five_percent(scenes):
    base = replace(BASE, infrared=replace(BASE.infrared, speckle_contrast=0.01))
    found = fit_pictures(scenes, base)
    for key in ("ambient", "infrared.psf_px", "infrared.read_noise_e"):
        assert key not in found.unknown
        assert found.values[key] == pytest.approx(HIDDEN[key], rel=0.05), key
        assert found.errors[key] < 0.1
    assert found.values["infrared.electrons_at_white"] == pytest.approx(2500, rel=0.05)
    assert found.misfit < 2
    assert "infrared.speckle_contrast" in found.unknown  # there is none
    assert found.distance_m == pytest.approx(1.1, abs=0.02)


def test_an_amplifier_that_is_told_does_not_pass_for_fewer_electrons(scenes):
    """Twice the grey values of as many electrons are what a gain of 2 gives."""
    dim = scenes[2]
    left, off = ([2.0 * image for image in images] for images in (dim.left, dim.off))
    assert np.max(left) < 255
    found = fit_pictures([replace(dim, left=left, off=off)], BASE, gain=2.0)
    for key in NOISE[1:]:
        assert found.values[key] == pytest.approx(HIDDEN[key], rel=0.1), key
    assert any("at the pictures' gain of 2" in line for line in report(found, BASE, 1))
    assert any("say gain=G" in line for line in report(replace(found, gain=1.0), BASE, 1))
    with pytest.raises(ConfigError, match="gain must be >= 1"):
        fit_pictures([dim], BASE, gain=0.5)


def test_one_frame_does_not_tell_noise(scenes):
    single = [replace(scene, left=scene.left[:1]) for scene in scenes[:1]]
    found = fit_pictures(single, BASE)
    for key in ("infrared.read_noise_e", "infrared.electrons_at_white"):
        assert "two or more frames" in found.unknown[key]
        assert found.values[key] == getattr(BASE.infrared, key.split(".")[1])


@pytest.mark.parametrize("frames", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_clipped_pictures_are_said_to_be_clipped(scenes, frames):
    """Not that they hold too few dots, or too much noise: another exposure helps."""
    white = [np.clip(4.0 * image, 0, 255) for image in scenes[0].left[:frames]]
    found = fit_pictures([replace(scenes[0], left=white, off=())], BASE)
    for key in ("ambient", "infrared.psf_px"):
        assert found.unknown[key].startswith("over 1% of the pixels are black or white")


def test_statistics_of_shifted_noise():
    """Texture of the shape of a box: neighbours share what overlaps; noise is not shared."""
    rng = np.random.default_rng(0)
    noise = cv2.blur(rng.standard_normal((500, 500)), (1, 3)) * np.sqrt(3)
    grey = torch.from_numpy(100 * (1 + 0.1 * noise))
    white = torch.from_numpy(rng.standard_normal((500, 500)) * 5)
    plain, noisy = statistics(grey), statistics(grey + white)
    # Over rows and columns: none along a row; along a column 2/3 and 1/3.
    expected = 0.01 * np.array([1 / 3, 1 / 6, 0, 0, 0, 0])
    np.testing.assert_allclose(plain.shared, expected, atol=3e-4)
    np.testing.assert_allclose(noisy.shared, expected, atol=3e-4)
    assert abs(float(plain.skewness)) < 1e-4


def test_the_command_writes_a_preset_that_composes(scenes, tmp_path, capsys):
    save(tmp_path / "pictures", scenes)
    out = tmp_path / "sensor" / "mine.yaml"
    out.parent.mkdir()
    words = ["fit", f"images={tmp_path / 'pictures'}", f"out={out}"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "3 scenes, 1.10 m away" in said
    assert "infrared.psf_px" in said
    assert "dots over ambient" in said
    assert re.search(
        r"near: realsense_d415 fills \d+\.\d%.*; the camera's own depth: 100\.0%", said
    )
    product = BASE.focal_px * BASE.baseline_m
    (line,) = re.findall(r"^f B +(.*)", said, re.MULTILINE)
    assert float(line.split(" px m")[0]) == pytest.approx(product, rel=1e-3)
    written = yaml.safe_load(out.read_text())
    assert written["baseline_m"] == pytest.approx(BASE.baseline_m, rel=1e-3)
    assert written["defaults"][0] == "realsense_d415"
    assert written["ambient"] == pytest.approx(HIDDEN["ambient"], rel=0.07)
    assert written["infrared"]["psf_px"] == pytest.approx(HIDDEN["infrared.psf_px"], rel=0.07)
    text = out.read_text()
    assert text.splitlines()[1].startswith("# qs3 fit images=")
    found = build(composed(None, f"hydra.searchpath=[file://{tmp_path}]", "+sensor=mine").sensor)
    assert isinstance(found, SpeckleStereo)
    assert found.ambient == pytest.approx(written["ambient"])
    assert found.pattern.columns == BASE.pattern.columns


@pytest.mark.parametrize("cameras", [1, 2])
def test_f_b_is_said_or_said_to_be_unknown(cameras, scenes, tmp_path, capsys):
    one = replace(scenes[0], left=scenes[0].left[:1], right=scenes[0].right[: cameras - 1])
    save(tmp_path / "pictures", [one])
    out = tmp_path / "mine.yaml"
    assert main(["fit", f"images={tmp_path / 'pictures'}", f"out={out}"]) == 0
    (line,) = re.findall(r"^f B +(.*)", capsys.readouterr().out, re.MULTILINE)
    baseline = yaml.safe_load(out.read_text()).get("baseline_m")
    if cameras == 2:
        assert line.startswith("55.2")
        assert "f and B alone cannot be told apart" in line
        assert baseline == pytest.approx(BASE.baseline_m, rel=1e-3)
        assert "f B:" not in out.read_text()
    else:
        assert line.startswith("unknown: one camera's pictures show no disparity")
        assert "SCENE_right.png" in line
        assert line.endswith("baseline_m 0.055 stay")
        assert "\n# not known: f B: one camera's pictures" in out.read_text()
        assert baseline is None


@pytest.mark.parametrize(
    ("depth_m", "grey", "why"),
    [
        (None, 1.0, "needs a depth image"),
        (np.nan, 1.0, "needs a depth image"),  # an empty one
        (0.9, 0.0, "no pixel has both a disparity"),
    ],
)
def test_right_pictures_alone_do_not_tell_the_baseline(scenes, depth_m, grey, why):
    base = replace(BASE, width_px=200, height_px=160)
    place = slice(-160, None), slice(-200, None)
    left, right = [scenes[0].left[0][place]], [grey * scenes[0].right[0][place]]
    depth = None if depth_m is None else np.full(left[0].shape, depth_m)
    found = fit_pictures([Pictures("near", left, right, (), depth)], base, distance_m=0.9)
    assert found.distance_m == pytest.approx(0.9)
    assert found.focal_baseline is None
    assert why in found.unknown[FOCAL_BASELINE]


@pytest.mark.parametrize("cameras", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_simulated_pictures_are_of_as_many_cameras_as_asked_for(cameras, tmp_path):
    into = tmp_path / "pictures"
    simulated_pictures.main(f"into={into}", f"cameras={cameras}")
    found = read_pictures(into)
    assert [scene.name for scene in found] == ["dim", "far", "near"]
    for scene in found:
        assert len(scene.left) == 8
        assert len(scene.right) == 8 * (cameras - 1)
        assert len(scene.off) == 1
        assert np.isfinite(scene.depth_m).all()


def test_simulated_right_pictures_are_the_left_ones_moved_by_the_disparity(scenes):
    for scene in scenes:
        left, right = (np.mean(images, axis=0) for images in (scene.left, scene.right))
        moved = round(BASE.focal_px * BASE.baseline_m / float(np.median(scene.depth_m)))
        same = left[30:-30, moved + 30 : -30], right[30:-30, 30 : -30 - moved]
        assert np.corrcoef(same[0].ravel(), same[1].ravel())[0, 1] > 0.8
        apart = left[30:-30, moved + 35 : -25], right[30:-30, 30 : -30 - moved]
        assert abs(np.corrcoef(apart[0].ravel(), apart[1].ravel())[0, 1]) < 0.3


def test_focal_length_times_baseline_by_disparity_and_depth(renderer):
    """Both pictures over the whole row, as devices give them."""
    sensor = SpeckleStereo(
        width_px=320, height_px=200, focal_px=300.0, baseline_m=0.061, step_px=1, ambient=0.5,
        min_depth_m=0.5, infrared=InfraredCamera(psf_px=0.8),
        pattern=Speckle(columns=300, rows=240, dot_px=1), matcher=BASE.matcher,
    )  # fmt: skip
    wall = square(1.0, 1.5)
    box = np.array([[0.99, -0.9, -0.4], [1.01, 0.9, 0.4]])
    frame = sensor.scan((wall,), box, POSE, renderer, np.random.default_rng(0))
    left, right = (frame.images[side] for side in ("left", "right"))
    assert left.shape == right.shape
    off_by_a_fifth = replace(sensor, baseline_m=0.05)
    scene = Pictures("wall", [left], [right], (), frame.clean_m)
    found = fit_pictures([scene], off_by_a_fifth)
    assert FOCAL_BASELINE not in found.unknown
    assert found.focal_baseline == pytest.approx(300 * 0.061, rel=0.01)


@pytest.mark.parametrize(
    ("images", "error", "message"),
    [
        ([np.full((60, 80), 90.0)], DataError, "too small"),
        ([np.full((200, 200), 1.0)], DataError, "black"),
        ([np.random.default_rng(0).normal(90, 5, (200, 200))], DataError, "no dots"),
        ([np.full((200, 200), 90.0), np.full((200, 210), 90.0)], DataError, "different sizes"),
    ],
)
def test_pictures_that_show_nothing_are_refused(images, error, message):
    with pytest.raises(error, match=message):
        fit_pictures([Pictures("a", images)], BASE, distance_m=1.0)


def test_without_a_distance_there_is_none(scenes):
    with pytest.raises(ConfigError, match="distance=METRES"):
        fit_pictures([replace(scenes[0], depth_m=None)], BASE)


def test_folders_and_files_are_explained(tmp_path, capsys):
    with pytest.raises(MissingDataError, match="no such folder"):
        read_pictures(tmp_path / "none")
    (tmp_path / "photo.png").write_bytes(b"x")
    with pytest.raises(MissingDataError, match="SCENE_left"):
        read_pictures(tmp_path)
    (tmp_path / "a_left.png").write_bytes(b"x")
    with pytest.raises(DataError, match=r"a_left\.png"):
        read_pictures(tmp_path)
    assert main(["fit", f"images={tmp_path}", "base=kinect_v1", "out=x.yaml"]) == 1
    assert "no active stereo camera" in capsys.readouterr().err
    assert main(["fit", "base=realsense_d415", "out=x.yaml", "focal=3", "a.npy"]) == 1
    assert "belong to images=" in capsys.readouterr().err


def test_the_command_does_not_write_over_its_base(tmp_path, capsys):
    out = tmp_path / "realsense_d415.yaml"
    assert main(["fit", f"images={tmp_path}", "base=realsense_d415", f"out={out}"]) == 1
    assert "realsense_d415 itself: its values would be lost" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    "more",
    ["intrinsics=1,1,1,1", "focal=640", "distances=1,2", "baseline=0.05", "power=2", "few=true"],
)
def test_what_is_for_frames_of_a_wall_is_refused_beside_pictures(more, tmp_path, capsys):
    words = ["fit", f"images={tmp_path}", f"out={tmp_path / 'x.yaml'}", more]
    assert main(words) == 1
    assert f"{more.partition('=')[0]}= would have no effect" in capsys.readouterr().err


def test_capitals_count_and_frames_that_are_left_out_are_said(tmp_path, caplog):
    image = np.full((16, 16), 90, np.uint8)
    for k in range(70):
        cv2.imwrite(str(tmp_path / f"a_left_{k}.png"), image)
    (tmp_path / "b_Left.PNG").write_bytes((tmp_path / "a_left_0.png").read_bytes())
    found = read_pictures(tmp_path)
    assert [(one.name, len(one.left)) for one in found] == [("a", 64), ("b", 1)]
    assert "a_left has 70 frames: the first 64" in caplog.text


def test_dots_over_ambient_are_those_of_the_pictures(scenes):
    """The brightest percent of what the projector adds, over what is there without it."""
    found = fit_pictures(scenes, BASE)
    dim = scenes[2]  # at the middle of the three distances
    off = np.mean(dim.off, axis=0)[30:-30, 30:-30].mean()
    added = np.mean(dim.left, axis=0)[30:-30, 30:-30] - off
    assert found.distance_m == pytest.approx(float(np.nanmedian(dim.depth_m)), rel=1e-3)
    assert found.dots_over_ambient == pytest.approx(np.quantile(added, 0.99) / off, rel=0.05)


SECOND = {
    "ambient": 0.5,
    "infrared.psf_px": 0.9,
    "infrared.speckle_contrast": 0.3,
    "infrared.electrons_at_white": 5000.0,
    "infrared.read_noise_e": 25.0,
}


@pytest.fixture(scope="module")
def of_another_camera(renderer):
    """Another lens, baseline, light and noise, with speckle; both pictures over the whole row."""
    camera = InfraredCamera(**{k.split(".")[1]: v for k, v in SECOND.items() if "." in k})
    sensor = SpeckleStereo(
        width_px=520, height_px=420, focal_px=480.0, baseline_m=0.061, step_px=1, min_depth_m=0.5,
        ambient=SECOND["ambient"], infrared=camera, matcher=BASE.matcher,
        pattern=replace(BASE.pattern, seed=5, columns=480, rows=400), tan_half_width=0.8,
    )  # fmt: skip
    taken = []
    for name, depth_m, gain in (("near", 0.9, 30.0), ("far", 1.4, 40.0), ("dim", 1.1, 12.0)):
        seen = replace(sensor, infrared=replace(camera, fixed_gain=gain))
        wall = square(depth_m, 1.5)
        box = np.array([[depth_m - 0.01, -1.0, -0.8], [depth_m + 0.01, 1.0, 0.8]])
        still, frames = StillRenderer(renderer, seed=3), []
        for i in range(6):
            still.rewind()
            frames.append(seen.scan((wall,), box, POSE, still, np.random.default_rng([i, 7])))
        off = replace(seen, projector_strength=1e-9)
        dark = off.scan((wall,), box, POSE, renderer, np.random.default_rng(9)).images["left"]
        left, right = ([f.images[side] for f in frames] for side in ("left", "right"))
        taken.append(Pictures(name, left, right, [dark], frames[0].clean_m))
    return sensor, taken


def test_a_second_camera_with_speckle_and_its_baseline_are_found_together(of_another_camera):
    sensor, taken = of_another_camera
    base = replace(
        sensor, baseline_m=0.05, ambient=0.2, pattern=replace(sensor.pattern, seed=8),
        infrared=InfraredCamera(
            psf_px=0.6, speckle_contrast=0.15, electrons_at_white=10_000, read_noise_e=60
        ),
    )  # fmt: skip
    found = fit_pictures(taken, base)
    assert found.focal_baseline == pytest.approx(480 * 0.061, rel=0.01)
    for key, value in SECOND.items():
        assert key not in (*found.unknown, *found.rough), key
        assert found.values[key] == pytest.approx(value, rel=0.05), key


def test_two_frames_of_a_dim_wall_do_not_tell_noise_within_five_percent(of_another_camera):
    sensor, (*_, dim) = of_another_camera
    found = fit_pictures([replace(dim, left=dim.left[:2], right=[])], sensor)
    for key in ("infrared.electrons_at_white", "infrared.read_noise_e"):
        assert key in (*found.unknown, *found.rough)
    said = [line for line in report(found, sensor, 1) if "not sure within 5%" in line]
    assert len(said) == len(found.rough)
