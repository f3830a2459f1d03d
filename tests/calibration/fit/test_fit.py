"""`qs3 fit` must find what cameras hide."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from qs3.calibration.bench.laws import nguyen_axial_m
from qs3.calibration.fit.cli import fit
from qs3.errors import DataError
from qs3.sensors.devices.fitted import FittedDepth
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from tests.running import main
from tests.sensors.scenery import plane, scan

SMALL = FittedDepth(width_px=200, height_px=150, focal_px=180.0)
STEP = 1 / (8 * 43.5)  # of 1 / Z: eighths of a pixel of a Kinect
POSES = [(0.9, 8), (1.4, -6), (2.0, 10), (3.0, 7), (2.0, 30), (2.0, 55)]
KINECT = Path(__file__).resolve().parents[4] / "shared" / "data" / "kinect_v1"

HIDDEN = {
    "steps of 1/Z, smooth holes": FittedDepth(
        noise_factor=0.0013, inverse_step_per_m=1 / (8 * 43.5), bias_m=(0.004, -0.003),
        tilts_deg=(0, 40, 70), fill_rates=(0.97, 0.95, 0.6), hole_px=2.0, correlation_px=1.5,
    ),
    "noise with a floor, growing with Z": FittedDepth(
        width_px=320, height_px=240, focal_px=250.0, noise_floor_m=0.001, noise_factor=0.002,
        noise_power=1.0, bias_m=(0.01,), fill_rates=(0.9,),
    ),
    "fine steps, wide noise": FittedDepth(
        width_px=424, height_px=240, focal_px=212.0, noise_factor=0.004, correlation_px=3.0,
        inverse_step_per_m=1 / (32 * 10.6), fill_rates=(0.99,), bias_m=(0.0, 0.01),
    ),
}  # fmt: skip


def wall(sensor, depth_m, tilt_deg, seed):
    """[h, w] float32 of a wall turned about the vertical axis, depth_m away in the middle."""
    k, angle = sensor.intrinsics, np.deg2rad(tilt_deg)
    x = ((np.arange(k.width_px) - k.cx_px) / k.focal_px)[None]
    y = ((np.arange(k.height_px) - k.cy_px) / k.focal_px)[:, None]
    along = np.sin(angle) * x + np.cos(angle) + 0 * y
    with np.errstate(divide="ignore"):
        clean = np.where(along > 0, depth_m * np.cos(angle) / along, np.inf)
    cosine = np.abs(along) / np.sqrt(x**2 + y**2 + 1)
    rng = np.random.default_rng(seed)
    return sensor.measure(clean.astype(np.float32), cosine.astype(np.float32), rng)[0]


def camera_of(sensor):
    k = sensor.intrinsics
    return f"{k.focal_px},{k.focal_px},{k.cx_px},{k.cy_px}"


def fitted(folder, files, *arguments):
    out = folder / "found.yaml"
    assert main(["fit", *map(str, files), f"out={out}", "few=true", *arguments]) == 0
    assert out.with_suffix(".png").stat().st_size > 20_000
    text = out.read_text()
    settings = yaml.safe_load(text)
    assert settings.pop("_target_") == "qs3.sensors.devices.fitted.FittedDepth"
    return FittedDepth(
        **{k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()}
    ), text


def recovered(folder, hidden, poses=POSES[:4], *arguments):
    """What is found from frames of walls at (distance, tilt) that a hidden sensor made."""
    files = [folder / f"{i}.npy" for i in range(len(poses))]
    for i, (depth, tilt) in enumerate(poses):
        np.save(files[i], wall(hidden, depth, tilt, seed=i))
    return fitted(folder, files, f"intrinsics={camera_of(hidden)}", *arguments)


@pytest.mark.parametrize("name", HIDDEN)
def test_hidden_parameters_are_recovered(name, tmp_path):
    hidden = HIDDEN[name]
    distances = ",".join(str(depth) for depth, _ in POSES)
    found, text = recovered(tmp_path, hidden, POSES, f"distances={distances}")
    assert found.noise_power == hidden.noise_power
    for depth in (0.9, 1.5, 2.5, 3.0):
        assert found.noise_law_m(depth) == pytest.approx(hidden.noise_law_m(depth), rel=0.1)
        bias = np.polynomial.polynomial.polyval
        allowed = 0.001 + 0.1 * hidden.inverse_step_per_m * depth**2
        assert bias(depth, found.bias_m) == pytest.approx(bias(depth, hidden.bias_m), abs=allowed)
    assert found.inverse_step_per_m == pytest.approx(hidden.inverse_step_per_m, rel=0.02)
    assert found.depth_step_m == 0
    for tilt in (5, 20, 40, 60):
        rates = [np.interp(tilt, s.tilts_deg, s.fill_rates) for s in (found, hidden)]
        assert rates[0] == pytest.approx(rates[1], abs=0.02)
    assert found.correlation_px == pytest.approx(hidden.correlation_px, rel=0.1, abs=0.05)
    assert "qs3 fit" in text


def test_other_things_before_the_wall_and_millimetre_pictures(tmp_path):
    hidden = FittedDepth(noise_factor=0.002)
    files = []
    for i, (depth, tilt) in enumerate(POSES[:4]):
        image = wall(hidden, depth, tilt, seed=i)
        image[200:400, 100:300] = 0.6  # a box, a fifth of the view
        image[:90] = np.nan
        files.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(files[-1]), np.nan_to_num(image * 1000).astype(np.uint16))
    found, _ = fitted(tmp_path, files, f"intrinsics={camera_of(hidden)}")
    assert found.noise_law_m(2.0) == pytest.approx(0.008, rel=0.1)
    assert found.depth_step_m == pytest.approx(0.001)
    assert found.inverse_step_per_m == 0
    assert found.bias_m == (0.0,)


def test_one_distance_cannot_tell_the_law(tmp_path):
    hidden = replace(SMALL, noise_factor=0.003)
    found, text = recovered(tmp_path, hidden, [(1.5, 4)])
    assert found.noise_power == 2
    assert found.noise_factor == pytest.approx(0.003, rel=0.05)
    assert "assumed: all walls are equally far" in text


def test_three_distances_are_asked_for_and_said(tmp_path, capsys):
    for name, depth_m, seed in (("a", 1.0, 0), ("b", 1.02, 1), ("c", 1.6, 2), ("d", 2.4, 3)):
        np.save(tmp_path / f"{name}.npy", wall(TINY, depth_m, 6, seed))
    (tmp_path / "copy.npy").write_bytes((tmp_path / "d.npy").read_bytes())
    out = tmp_path / "found.yaml"

    def run(names, *more):
        files = [str(tmp_path / f"{name}.npy") for name in names]
        status = main(["fit", *files, "focal=110", f"out={out}", *more])
        return status, *capsys.readouterr()

    for names in (["a"], ["a", "b", "c"], ["d", "copy", "c"]):
        status, _, error = run(names)
        assert status == 1
        assert f"the frames show walls at {1 if names == ['a'] else 2} distance" in error
        assert "few=true" in error
        assert not out.exists()
    status, said, _ = run(["a", "c", "d", "copy"], "distances=1,1.6,2.4,2.4")
    assert status == 0
    assert "copy.npy: the same depths as d.npy, so they count once" in said
    low, high = re.search(r"walls +seen from ([\d.]+) to ([\d.]+) m; beyond", said).groups()
    assert float(low) < 1 < 2.4 < float(high)
    assert f"walls from {low} to {high} m; beyond that noise, steps and bias\n# are extrap" in (
        out.read_text()
    )
    assert run(["a", "b"], "few=true")[0] == 0


def test_the_steps_of_a_simulated_kinect_are_found(tmp_path, renderer):
    """Frames of matched images, not of this model: 1/8 px steps of f b = 43.5 px m."""
    sensor, files = ReferenceSpeckle(), []
    for i, (depth, tilt) in enumerate([(1.2, 12), (1.9, -15), (2.6, 20)]):
        frame = scan(sensor, [plane(depth, 0.45, tilt)], renderer, seed=i)
        whole = np.full((sensor.height_px, sensor.width_px), np.nan, np.float32)
        height, width = frame.depth_m.shape
        place = (slice(frame.top, frame.top + height), slice(frame.left, frame.left + width))
        whole[place] = np.where(frame.label == 1, frame.depth_m, np.nan)
        files.append(tmp_path / f"{i}.npy")
        np.save(files[-1], whole)
    found, _ = fitted(tmp_path, files, "focal=580")
    assert 1 / (8 * found.inverse_step_per_m) == pytest.approx(43.5, rel=0.02)
    assert found.noise_power == 2


@pytest.mark.parametrize("share", [0.1, 0.25])
def test_noise_far_below_a_step_is_found(share, tmp_path):
    """Taking step^2 / 12 off the variance would leave nothing but its own error."""
    hidden = FittedDepth(noise_factor=share * STEP, inverse_step_per_m=STEP)
    found, _ = recovered(tmp_path, hidden)
    assert found.noise_law_m(2.0) == pytest.approx(hidden.noise_law_m(2.0), rel=0.05)
    assert found.correlation_px == 0


def test_walls_that_show_too_few_levels_are_refused(tmp_path, capsys):
    hidden = replace(SMALL, noise_factor=0.3 * STEP, inverse_step_per_m=STEP)
    np.save(tmp_path / "a.npy", wall(hidden, 1.5, 0.5, seed=0))
    out = [f"out={tmp_path / 'x.yaml'}"]
    assert main(["fit", str(tmp_path / "a.npy"), "focal=180", *out]) == 1
    assert "turn the camera by a few degrees" in capsys.readouterr().err
    # Three such walls show the step, but two or three levels each hide noise far below it.
    quiet = replace(SMALL, noise_factor=0.2 * STEP, inverse_step_per_m=STEP)
    files = [str(tmp_path / f"{i}.npy") for i in range(3)]
    for i, depth in enumerate((1.0, 1.7, 2.5)):
        np.save(files[i], wall(quiet, depth, 0.2, seed=i))
    assert main(["fit", *files, "focal=180", *out]) == 1
    assert "turn the camera by a few degrees" in capsys.readouterr().err


def test_a_lens_that_bends_the_wall_adds_no_noise(tmp_path):
    hidden, files = FittedDepth(noise_factor=0.001), []
    bend = 0.01 * np.linspace(-1, 1, 640, dtype=np.float32) ** 3
    for i, (depth, tilt) in enumerate(POSES[:4]):
        files.append(tmp_path / f"{i}.npy")
        np.save(files[-1], wall(hidden, depth, tilt, seed=i) + bend)
    found, _ = fitted(tmp_path, files, f"intrinsics={camera_of(hidden)}")
    for depth in (1.0, 2.0, 3.0):
        assert found.noise_law_m(depth) == pytest.approx(hidden.noise_law_m(depth), rel=0.1)


def test_the_true_distance_is_that_at_the_principal_point(tmp_path):
    """Half a pixel off it, a wall at a slant of 60 degrees is 1 % further away."""
    hidden = FittedDepth(width_px=200, height_px=150, focal_px=56.0, noise_factor=0.0005)
    poses = [(1.0, 50), (1.5, -50), (2.0, 50)]
    found, _ = recovered(tmp_path, hidden, poses, "distances=1,1.5,2")
    for depth in (1.0, 1.5, 2.0):
        assert abs(np.polynomial.polynomial.polyval(depth, found.bias_m)) < 0.0007


def test_walls_that_face_the_camera_do_not_hide_their_steps(tmp_path):
    """Three distances with some levels each, in whole millimetres."""
    hidden = FittedDepth(
        noise_factor=0.7 * STEP, inverse_step_per_m=STEP, depth_step_m=0.001, fill_rates=(0.93,)
    )
    found, _ = recovered(tmp_path, hidden, [(1.0, 0.2), (1.7, 0.2), (2.5, 0.2)])
    assert found.inverse_step_per_m == pytest.approx(STEP, rel=0.02)
    assert found.depth_step_m == pytest.approx(0.001)
    assert found.noise_law_m(2.0) == pytest.approx(hidden.noise_law_m(2.0), rel=0.05)
    assert np.mean(found.fill_rates) == pytest.approx(0.93, abs=0.01)


def test_whole_millimetres_alone_are_no_steps_of_a_disparity(tmp_path):
    hidden = FittedDepth(
        noise_floor_m=0.0015, noise_factor=0.001, noise_power=1, depth_step_m=0.001
    )
    found, _ = recovered(tmp_path, hidden, [(1.0, 0.0), (1.7, 0.0), (2.5, 0.0)])
    assert found.inverse_step_per_m == 0
    assert found.noise_law_m(2.0) == pytest.approx(0.0035, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.6, 4.0])
def test_smooth_noise_below_a_step_is_found_to_be_smooth(size, tmp_path):
    """Rounding tears neighbours apart; a simulation with the same steps knows by how much."""
    hidden = FittedDepth(noise_factor=0.3 * STEP, inverse_step_per_m=STEP, correlation_px=size)
    found, _ = recovered(tmp_path, hidden)
    assert found.correlation_px == pytest.approx(size, rel=0.15)


SMALLER = FittedDepth(width_px=240, height_px=180, focal_px=220.0, noise_factor=0.0015)


def kitchen(depth_m, relief, seed, sensor=SMALLER):
    """A front of cupboards: 40 things that stand out from a plane, or are set back."""
    rng, k = np.random.default_rng(seed), sensor.intrinsics
    clean = np.full((k.height_px, k.width_px), depth_m, dtype=np.float32)
    clean /= 1 + 0.1 * (np.arange(k.width_px, dtype=np.float32) - k.cx_px) / k.focal_px
    for _ in range(40):
        width, height = rng.integers(12, 70, 2)
        row, col = rng.integers(0, k.height_px - 10), rng.integers(0, k.width_px - 10)
        clean[row : row + height, col : col + width] *= 1 + rng.uniform(-relief, relief)
    return sensor.measure(clean, np.full_like(clean, 0.95), rng)[0]


def told(folder, images, capsys):
    """Exit status and what was printed of a fit of some images."""
    files = [folder / f"{name}.npy" for name in images]
    for file, image in zip(files, images.values(), strict=True):
        np.save(file, image)
    out = folder / "found.yaml"
    status = main(["fit", *map(str, files), "focal=220", f"out={out}", "few=true"])
    said = capsys.readouterr()
    return status, said.out + said.err, out


TINY = replace(SMALLER, width_px=120, height_px=90, focal_px=110.0)


@pytest.mark.parametrize("bad", [None, "middle", "far"])
def test_one_bad_frame_among_good_walls_is_named_and_good_ones_are_not(bad, tmp_path):
    """Frames so small that it takes a second; the command itself is tried below."""
    for seed, (name, depth_m) in enumerate((("near", 1.0), ("middle", 1.6), ("far", 2.4))):
        seen = kitchen(depth_m, 0.03, 1, TINY) if name == bad else wall(TINY, depth_m, 6, seed)
        np.save(tmp_path / f"{name}.npy", seen)
    files = [str(tmp_path / f"{name}.npy") for name in ("near", "middle", "far")]
    given = dict.fromkeys(("intrinsics", "unit", "distances", "baseline", "power"))
    if bad is None:
        found = fit(files, focal=110.0, **given)
        assert list(found.doubts) == []
        assert not any("doubtful" in line for line in found.summary())
        return
    with pytest.raises(DataError, match="not of a flat wall") as error:
        fit(files, focal=110.0, **given)
    assert re.findall(r"(\w+)\.npy: [\d.]+ to [\d.]+ mm off", str(error.value)) == [bad]
    assert str(error.value).count(".npy") == 1
    assert "the law of all frames says" in str(error.value)


@pytest.mark.slow
def test_a_kitchen_among_walls_is_named_and_refused(tmp_path, capsys):
    images = {
        "near": wall(SMALLER, 1.0, 5, seed=0),
        "kitchen": kitchen(1.6, 0.05, seed=1),
        "far": wall(SMALLER, 2.4, 5, seed=2),
    }
    status, said, out = told(tmp_path, images, capsys)
    assert status == 1
    assert "not of a flat wall:" in said
    assert "kitchen.npy: " in said
    assert "the law of all frames says" in said
    assert "near.npy: 1" not in said
    assert not out.exists()


@pytest.mark.slow
def test_kitchens_alone_agree_with_each_other_and_are_refused(tmp_path, capsys):
    """Their law fits them; errors of whole patches of the image are not a camera's noise."""
    images = {f"kitchen_{i}": kitchen(z, 0.05, seed=i) for i, z in enumerate((1.0, 1.6, 2.4))}
    status, said, out = told(tmp_path, images, capsys)
    assert status == 1
    for name in images:
        assert f"{name}.npy: errors of " in said
    assert not out.exists()


@pytest.mark.slow
def test_what_may_be_a_wall_is_doubted_in_the_preset_too(tmp_path, capsys):
    status, said, out = told(tmp_path, {"front": kitchen(1.6, 0.012, seed=1)}, capsys)
    assert status == 0
    assert "doubtful  front.npy: " in said
    assert "\n# doubtful: front.npy: " in out.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0, 1.5, 4.0])
def test_smooth_noise_on_walls_is_not_doubted(size, tmp_path, capsys):
    sensor = replace(SMALLER, correlation_px=size)
    images = {f"{i}": wall(sensor, z, tilt, seed=i) for i, (z, tilt) in enumerate(POSES)}
    status, said, _ = told(tmp_path, images, capsys)
    assert status == 0
    assert "doubtful" not in said


@pytest.mark.parametrize(("rate", "hole"), [(0.9, 1.0), (0.6, 3.0), (0.5, 8.0)])
def test_holes_of_any_size_count(rate, hole, tmp_path):
    found, _ = recovered(tmp_path, FittedDepth(fill_rates=(rate,), hole_px=hole))
    # Four frames hold some 300 holes a frame of the largest size: a few per cent of chance.
    assert np.mean(found.fill_rates) == pytest.approx(rate, abs=0.01 + 0.004 * hole)
    assert found.hole_px == pytest.approx(hole, rel=0.15)


def test_the_shadow_of_a_thing_is_no_hole_of_the_wall(tmp_path):
    image = wall(replace(SMALL, noise_factor=0.001), 2.0, 5, seed=0)
    image[60:90, 90:120] = 1.2
    image[60:90, 84:90] = np.nan
    np.save(tmp_path / "a.npy", image)
    found, _ = fitted(tmp_path, [tmp_path / "a.npy"], "focal=180")
    assert min(found.fill_rates) == 1


@pytest.mark.skipif(not KINECT.is_dir(), reason="no real Kinect clouds next to the checkout")
def test_real_kinect_clouds_have_eighths_of_a_pixel(tmp_path):
    files = sorted(KINECT.glob("*.pcd"))[:4]
    found, _ = fitted(tmp_path, files, "focal=575")
    # Published geometry: 580 px, 75 mm. Files hold whole millimetres.
    assert 1 / (8 * found.inverse_step_per_m) == pytest.approx(43.5, rel=0.03)
    assert found.depth_step_m == pytest.approx(0.001)
    step = found.inverse_step_per_m * 0.8**2
    total = np.hypot(found.noise_law_m(0.8), step / np.sqrt(12))
    assert total == pytest.approx(float(nguyen_axial_m(0.8)), rel=0.3)
    assert max(found.fill_rates) > 0.98


def test_a_preset_sees_walls_where_it_was_fitted(tmp_path):
    hidden = replace(SMALL, min_depth_m=0.05, max_depth_m=20.0, noise_factor=0.0015)
    near, _ = recovered(tmp_path, hidden, [(0.12, 8), (0.16, -6), (0.2, 10), (0.25, 7)])
    assert np.isfinite(wall(near, 0.12, 8, seed=0)).mean() > 0.99
    assert near.max_depth_m == 8
    far, _ = recovered(tmp_path, hidden, [(3.0, 8), (5.0, -6), (7.0, 10), (9.0, 7)])
    assert np.isfinite(wall(far, 9.0, 7, seed=0)).mean() > 0.99
    assert far.min_depth_m == 0.3
