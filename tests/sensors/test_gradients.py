"""The differentiable twin: the ordinary sensor forwards, finite differences backwards."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.gradients import settings_of, twin_of
from qs3.sensors.matching import StereoBlockMatcher
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.scenery import POSE, box_of, plane, rectangle

GAIN = 200.0
QUIET = InfraredCamera(psf_px=0.6, read_noise_e=0.0, electrons_at_white=1e9, fixed_gain=GAIN)
SENSOR = SpeckleStereo(
    width_px=270,
    height_px=270,
    focal_px=375.0,
    step_px=1,
    infrared=QUIET,
    matcher=StereoBlockMatcher(num_disparities=48, block_size=15),
)
SCENES = {
    "tilted plane": (plane(1.5, 0.25, tilt_deg=25),),
    "square before wall": (
        rectangle(1.4, -0.12, 0.12, -0.12, 0.12, albedo=0.5),
        rectangle(1.9, -0.3, 0.3, -0.25, 0.25, albedo=0.8),
    ),
}
LOWEST, HIGHEST = 12, 40


@pytest.fixture(scope="module")
def renderer():
    return MitsubaRenderer(samples=64)


@pytest.fixture(scope="module")
def twin(renderer):
    bodies = (plane(1.5, 0.14, tilt_deg=25),)
    return replace(twin_of(SENSOR, bodies, box_of(*bodies), POSE, renderer), fine=1)


@pytest.mark.parametrize(
    "name", ["tilted plane", pytest.param("square before wall", marks=pytest.mark.slow)]
)
def test_its_images_and_disparities_are_those_of_the_ordinary_sensor(name, renderer):
    bodies = SCENES[name]
    twin = replace(twin_of(SENSOR, bodies, box_of(*bodies), POSE, renderer), fine=4)
    settings = settings_of(SENSOR, GAIN)
    frame = SENSOR.scan(bodies, box_of(*bodies), POSE, renderer, np.random.default_rng(0))
    # Where the pixel and those that the lens and a block mix into it are of one surface.
    smooth = twin.left.smooth.numpy()
    inner, far = (cv2.erode(smooth.astype(np.uint8), np.ones((n, n))) > 0 for n in (7, 19))
    left, right = twin.grey(settings)
    ours, theirs = left.numpy()[inner], frame.images["left"].astype(float)[inner]
    assert inner.mean() > 0.25
    assert np.corrcoef(ours, theirs)[0, 1] > 0.997
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.005)
    found = twin.disparity(left, right, LOWEST, HIGHEST).numpy()
    ordinary = frame.images["disparity"]
    both = far & np.isfinite(ordinary)
    apart = np.abs(found - ordinary)[both]
    truth = SENSOR.focal_px * SENSOR.baseline_m / frame.clean_m
    assert np.median(apart) < 0.07
    assert np.mean(apart < 0.5) > 0.93
    assert np.median(np.abs(found - truth)[both]) < 0.04


KEYS = (
    "projector_strength", "ambient", "baseline_m", "focal_px", "gain", "infrared.psf_px",
    "infrared.electrons_at_white", "infrared.read_noise_e", "albedo",
)  # fmt: skip
NOISY = {"infrared.electrons_at_white": 3000.0, "infrared.read_noise_e": 40.0}


def outcome(twin, settings, what):
    """A number that depends on all that was computed, within one smooth surface."""
    noise = torch.Generator().manual_seed(5)
    return measured(twin, settings, what, *twin.grey(settings, noise))


def measured(twin, settings, what, left, right):
    if what == "images":
        weight = torch.linspace(-1, 1, left.numel(), dtype=left.dtype).reshape(left.shape)
        kept = twin.left.smooth * weight
        return (left * kept).mean() + ((left - 30).square() * kept).mean() / 50
    disparity = twin.disparity(left, right, 21, 29)
    depth = settings["focal_px"] * settings["baseline_m"] / disparity
    inner = torch.zeros_like(twin.left.smooth)
    inner[35:-35, 40:-40] = True
    return (depth - 1.5)[inner].square().mean() * 1e4 + depth[inner].mean()


@pytest.mark.parametrize("what", ["images", pytest.param("depth", marks=pytest.mark.slow)])
@pytest.mark.parametrize("key", KEYS)
def test_gradients_are_finite_differences(twin, key, what):
    settings = {
        name: torch.tensor(NOISY.get(name, float(value)), dtype=torch.float64)
        for name, value in settings_of(SENSOR, GAIN).items()
    }
    value = settings[key].clone().requires_grad_()
    outcome(twin, settings | {key: value}, what).backward()
    slopes = []
    for share in (1e-8, 3e-8):  # two steps: where they differ a maximum has moved
        step = share * float(value.detach())
        ends = [
            float(outcome(twin, settings | {key: value.detach() + side * step}, what))
            for side in (-1, 1)
        ]
        slopes.append((ends[1] - ends[0]) / (2 * step))
    assert slopes[0] == pytest.approx(slopes[1], rel=5e-3, abs=1e-9)
    assert float(value.grad) == pytest.approx(slopes[0], rel=0.01, abs=1e-9)
    assert slopes[0] != 0


def test_the_variance_of_speckle_grows_with_the_square_of_its_contrast(twin):
    contrast = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    settings = settings_of(SENSOR, 50.0) | {
        "infrared.speckle_contrast": contrast,
        "infrared.psf_px": torch.tensor(0.0, dtype=torch.float64),
        "projector_strength": torch.tensor(0.0, dtype=torch.float64),
        "ambient": torch.tensor(2.0, dtype=torch.float64),
    }
    found = []
    for seed in range(20):  # one picture scatters by 2 %
        grey = twin.grey(settings, torch.Generator().manual_seed(seed))[0]
        inside = grey[twin.left.albedo > 0.79]
        found.append(inside.var() / inside.mean() ** 2)
    relative = torch.stack(found).mean()
    assert float(relative.detach()) == pytest.approx(0.09, rel=0.01)
    relative.backward()
    assert float(contrast.grad) == pytest.approx(2 * 0.3, rel=0.01)
