"""How much of a picture pair a preset fills: a pair whose fill is known, and a simulated one."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.calibration.fit import pair_fill
from qs3.calibration.fit.infrared import Pictures
from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.matching.filters import SmallRegions
from qs3.sensors.optics.infrared import GreyNoise, InfraredCamera
from qs3.sensors.optics.patterns import Speckle
from qs3.sensors.pixel_status import Reason
from tests.sensors.scenery import POSE, square

BASE = build(composed(None, "+sensor=realsense_d415").sensor)
MATCHER = replace(BASE.matcher, num_disparities=32)
SHORT = replace(BASE, matcher=MATCHER, min_depth_m=2.0)
NOISE = BASE.infrared.noise(1.0)


def half_blank(height=120, width=300, shift=20):
    """Dots that are `shift` px to the left in the right picture; the upper half is blank."""
    rng = np.random.default_rng(0)
    wide = rng.integers(20, 230, (height, width + shift)).astype(np.float64)
    wide[: height // 2] = 90.0
    return wide[:, :width], wide[:, shift:]


def test_a_blank_half_is_lost_as_too_dark_and_a_filter_loses_its_own():
    left, right = half_blank()
    depth = np.where(np.arange(120)[:, None] % 4 > 0, 2.0, np.nan) * np.ones((1, 300))
    pair = Pictures("half", [left], [right], (), depth)
    (found,) = pair_fill.pair_fills([pair, Pictures("one", [left])], SHORT, NOISE)
    assert found.name == "half"
    assert found.fill == pytest.approx(0.5, abs=0.06)  # half a window at the border
    assert found.lost[Reason.DARK] == pytest.approx(0.5, abs=0.06)
    assert found.fill + sum(found.lost.values()) == pytest.approx(1)
    assert found.own == pytest.approx(0.75)
    said = pair_fill.words_of(found, "realsense_d415")
    assert said.startswith(f"half: realsense_d415 fills {found.fill:.1%} (lost: dark ")
    assert said.endswith("; the camera's own depth: 75.0%")
    strict = replace(SHORT, filters=(SmallRegions(max_size_px=10**6),))
    (filtered,) = pair_fill.pair_fills([pair], strict, NOISE)
    assert filtered.fill == 0
    assert filtered.lost[Reason.FILTERED] == pytest.approx(found.fill)


def test_a_simulated_pair_is_filled_as_the_sensor_fills_it(renderer):
    """Two walls, the nearer as black as soot: it is the share that the sensor's own depth lacks."""
    sensor = SpeckleStereo(
        width_px=320, height_px=200, focal_px=300.0, baseline_m=0.06, step_px=1, ambient=3.0,
        min_depth_m=0.6, infrared=InfraredCamera(psf_px=0.8, read_noise_e=60.0),
        pattern=Speckle(columns=300, rows=240, dot_px=1), matcher=MATCHER,
    )  # fmt: skip
    bodies = (square(1.0, 0.2, albedo=0.004), square(1.5, 2.0))
    box = np.array([[0.99, -0.9, -0.4], [1.51, 0.9, 0.4]])
    frame = sensor.scan(bodies, box, POSE, renderer, np.random.default_rng(0))
    left, right = (frame.images[side].astype(float) for side in ("left", "right"))
    (found,) = pair_fill.pair_fills(
        [Pictures("walls", [left], [right])], sensor, sensor.infrared.noise(1.0)
    )
    own = np.isfinite(frame.images["disparity"])[:, 32:].mean()
    assert 0.4 < own < 0.97
    assert found.fill == pytest.approx(own, abs=0.01)


def test_of_large_pictures_the_middle_rows_are_matched(monkeypatch):
    left, right = half_blank()
    monkeypatch.setattr(pair_fill, "_MOST_COSTS", 300 * 32 * 40)
    (found,) = pair_fill.pair_fills([Pictures("half", [left], [right])], SHORT, NOISE)
    assert found.fill == pytest.approx(0.5, abs=0.13)
    assert pair_fill._rows((120, 300), 32) == slice(40, 80)


def test_noise_of_the_pictures_and_not_of_the_preset_is_what_texture_must_exceed():
    """Blank pictures of a camera with a tenth of the electrons: textured by the preset."""
    rng = np.random.default_rng(3)
    noise = GreyNoise(1000.0, 10.0)
    blank = [
        np.clip(
            90 + np.sqrt(noise.variance(np.array(90.0))) * rng.standard_normal((120, 300)), 0, 255
        )
        for _ in range(2)
    ]
    pair = Pictures("blank", [blank[0]], [blank[1]])
    (by_preset,) = pair_fill.pair_fills([pair], SHORT, NOISE)
    (by_own,) = pair_fill.pair_fills([pair], SHORT, noise)
    assert by_preset.lost.get(Reason.DARK, 0) < 0.05
    assert by_own.lost[Reason.DARK] > 0.95
