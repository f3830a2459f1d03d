"""`qs3 fit` on frames of a wall: it must find what a camera hides."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from qs3.calibration.fit import fit_walls
from qs3.calibration.walls import find_steps, find_wall
from qs3.errors import ConfigError, DataError
from qs3.sensors.devices.fitted import FittedDepth
from tests.running import main

STEP = 1 / (8 * 43.5)  # of 1 / Z: eighths of a pixel of a Kinect
SMALL = FittedDepth(width_px=240, height_px=180, focal_px=220.0)
POSES = [(0.9, 8), (2.0, 10), (3.0, 7), (2.0, 55)]

HIDDEN = {
    "steps of 1/Z, smooth noise": replace(
        SMALL, noise_factor=0.0013, inverse_step_per_m=STEP, bias_m=(0.004, -0.003),
        correlation_px=1.5, fill_rate=0.97,
    ),
    "noise with a floor, growing with Z": replace(
        SMALL, noise_floor_m=0.001, noise_factor=0.002, noise_power=1.0, bias_m=(0.01,),
        fill_rate=0.9,
    ),
    "steps of a millimetre over those of 1/Z": replace(
        SMALL, noise_factor=0.0015, inverse_step_per_m=STEP, depth_step_m=0.001
    ),
    "whole millimetres alone": replace(
        SMALL, noise_floor_m=0.0015, noise_factor=0.001, noise_power=1.0, depth_step_m=0.001
    ),
    "noise of a quarter of a step": replace(
        SMALL, noise_factor=0.25 * STEP, inverse_step_per_m=STEP
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
    return sensor.measure(clean.astype(np.float32), np.random.default_rng(seed))[0]


def recovered(folder, hidden, poses=POSES, **more):
    """What is found from frames of walls at (distance, tilt) that a hidden sensor made."""
    files = [folder / f"{i}.npy" for i in range(len(poses))]
    for i, (depth, tilt) in enumerate(poses):
        np.save(files[i], wall(hidden, depth, tilt, seed=i))
    text, _ = fit_walls(files, None, hidden.focal_px, **more)
    given = yaml.safe_load(text)
    assert given.pop("_target_") == "qs3.sensors.devices.fitted.FittedDepth"
    return FittedDepth(**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()})


@pytest.mark.parametrize("name", HIDDEN)
def test_hidden_parameters_are_recovered(name, tmp_path):
    hidden = HIDDEN[name]
    found = recovered(tmp_path, hidden, distances=[depth for depth, _ in POSES])
    assert found.noise_power == hidden.noise_power
    for depth in (0.9, 1.5, 2.5, 3.0):
        assert found.noise_law_m(depth) == pytest.approx(hidden.noise_law_m(depth), rel=0.1)
        bias = np.polynomial.polynomial.polyval
        allowed = 0.002 + 0.2 * hidden.inverse_step_per_m * depth**2
        assert bias(depth, found.bias_m) == pytest.approx(bias(depth, hidden.bias_m), abs=allowed)
    assert found.inverse_step_per_m == pytest.approx(hidden.inverse_step_per_m, rel=0.02)
    assert found.depth_step_m == hidden.depth_step_m
    assert found.fill_rate == pytest.approx(hidden.fill_rate, abs=0.02)
    assert found.correlation_px == pytest.approx(hidden.correlation_px, abs=0.3)


def test_one_distance_gives_a_parabola(tmp_path):
    found = recovered(tmp_path, replace(SMALL, noise_factor=0.003), [(1.5, 4)])
    assert found.noise_power == 2
    assert found.noise_factor == pytest.approx(0.003, rel=0.05)


def test_a_bend_of_the_lens_is_not_noise():
    bend = 0.01 * np.linspace(-1, 1, SMALL.width_px, dtype=np.float32) ** 3
    seen = wall(replace(SMALL, noise_factor=0.001), 1.5, 8, seed=0) + bend
    found = find_wall("bent", seen, SMALL.intrinsics)
    sigma_m = np.nanstd(found.error_per_m * found.plane_m**2)
    assert sigma_m == pytest.approx(0.001 * 1.5**2, rel=0.1)
    assert find_steps([found]).inverse_per_m == 0


def test_the_command_on_pictures_with_other_things_before_the_wall(tmp_path):
    files = []
    for i, (depth, tilt) in enumerate(POSES[:3]):
        image = wall(replace(SMALL, noise_factor=0.002), depth, tilt, seed=i)
        image[70:140, 40:110] = 0.6  # a box, a ninth of the view
        image[:30] = np.nan
        files.append(str(tmp_path / f"{i}.png"))
        cv2.imwrite(files[-1], np.nan_to_num(image * 1000).astype(np.uint16))
    out = tmp_path / "found.yaml"
    k = SMALL.intrinsics
    camera = f"intrinsics={k.focal_px},{k.focal_px},{k.cx_px},{k.cy_px}"
    assert main(["fit", *files, camera, f"out={out}", "baseline=0.05"]) == 0
    assert out.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"
    found = yaml.safe_load(out.read_text())
    assert found["noise_factor"] * 4 + found["noise_floor_m"] == pytest.approx(0.008, rel=0.1)
    assert (found["depth_step_m"], found["baseline_m"], found["bias_m"]) == (0.001, 0.05, [0.0])
    with pytest.raises(ConfigError):
        fit_walls(files, None, k.focal_px, distances=[3.0, 2.0, 0.9])  # of other frames


def test_what_is_not_a_wall_is_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(DataError, match="clutter"):
        find_wall("clutter", rng.uniform(0.5, 4, (180, 240)), SMALL.intrinsics)
