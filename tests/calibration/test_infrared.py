"""A preset from infrared pictures: what a simulated camera hides is found again."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import yaml

from qs3.calibration.infrared import statistics
from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.sensors.matching import StereoBlockMatcher
from qs3.sensors.optics.misalignment import Misalignment
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.running import main
from tests.sensors.scenery import POSE, box_of, square


def test_neighbours_share_texture_and_not_noise():
    """Texture of the shape of a box of three rows: neighbours share what overlaps."""
    rng = np.random.default_rng(0)
    texture = cv2.blur(rng.standard_normal((500, 500)), (1, 3)) * np.sqrt(3)
    grey = torch.from_numpy(100 * (1 + 0.1 * texture))
    white = torch.from_numpy(rng.standard_normal((500, 500)) * 5)
    expected = 0.01 * np.array([2, 2 / 3, 1 / 3, 0, 0])  # rows and columns together
    np.testing.assert_allclose(statistics(grey), expected, atol=6e-4)
    noisy = statistics(grey + white)
    np.testing.assert_allclose(noisy[1:], expected[1:], atol=6e-4)
    assert float(noisy[0]) == pytest.approx(expected[0] + 2 * 0.05**2, rel=0.05)


@pytest.mark.slow
def test_the_command_finds_light_blur_and_noise(tmp_path):
    """Pictures by the preset with other light, lens and noise, and other dots of the same kind."""
    base, distance_m = build(composed(None, "+sensor=realsense_d415").sensor), 1.1
    hidden = {"psf_px": 1.2, "read_noise_e": 40.0}
    camera = replace(
        base, ambient=1.2, infrared=replace(base.infrared, fixed_gain=35.0, **hidden),
        pattern=replace(base.pattern, seed=77), misalignment=Misalignment(), filters=(),
        matcher=StereoBlockMatcher(num_disparities=128),  # its disparity is not looked at
    )  # fmt: skip
    half_m = 220 * distance_m / camera.focal_px
    renderer = MitsubaRenderer(samples=16)
    for word, strength in (("", camera.projector_strength), ("_off", 1e-9)):
        seen = replace(camera, projector_strength=strength)
        box = box_of(square(distance_m, half_m))
        rng = np.random.default_rng(len(word))
        frame = seen.scan((square(distance_m, 2 * half_m),), box, POSE, renderer, rng)
        for side in ("left", "right"):
            image = frame.images[side][60:-60, 60:-60]
            cv2.imwrite(str(tmp_path / f"{side}{word}.png"), image)
    out = tmp_path / "sensor" / "mine.yaml"
    out.parent.mkdir()
    assert main(["fit", f"images={tmp_path}", f"distance={distance_m}", f"out={out}"]) == 0
    found = yaml.safe_load(out.read_text())
    assert found["ambient"] == pytest.approx(1.2, rel=0.05)
    for key, value in hidden.items():
        assert found["infrared"][key] == pytest.approx(value, rel=0.08), key
    mine = build(composed(None, f"hydra.searchpath=[file://{tmp_path}]", "+sensor=mine").sensor)
    assert mine.infrared == replace(base.infrared, **found["infrared"])
