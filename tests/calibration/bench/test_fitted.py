"""Presets by `qs3 fit` on the bench: what the camera's frames say of it is no fault of the preset.

Its steps, its bias, its holes and a projector to the left of the camera.
"""

from dataclasses import replace

import numpy as np
import pytest

from qs3.calibration.bench import bands, edges, metrics, planar, rooms, runner
from qs3.calibration.bench.subject import Subject
from qs3.sensors.devices.fitted import FittedDepth
from qs3.sensors.renderers.mitsuba import MitsubaRenderer

FITTED = FittedDepth(
    width_px=320, height_px=240, focal_px=290, baseline_m=0.075, noise_factor=0.0027
)


@pytest.fixture(scope="module")
def renderer():
    return MitsubaRenderer(samples=4)  # it measures depths, whatever the light


@pytest.mark.parametrize("steps", [(0.0, 0.0), (0.00575, 0.001), (0.0, 0.01)])
def test_the_law_holds_the_steps(renderer, steps):
    """What is measured holds the quantiser."""
    step, depth_step = steps
    sensor = replace(FITTED, inverse_step_per_m=step, depth_step_m=depth_step)
    for depth in (0.5, 2.0):
        condition = planar.PlanarCondition(depth, phases=8, half_px=20)
        found = planar.measure(Subject("mine", sensor), condition, renderer)
        stated = found["law_m"] * metrics.TRIMMED_NORMAL
        assert found["sigma_m"] == pytest.approx(stated, rel=0.08), (depth, stated)


def test_a_bias_is_held_against_the_steps_at_its_distance():
    """Millimetres are a fifth of a pixel at 0.3 m, and next to nothing at 3 m."""
    subject = Subject("mine", replace(FITTED, depth_step_m=0.001))
    for depth, passed in ((0.3, True), (3.0, False)):
        result = runner.SensorResult(subject, {})
        plane = {"tilt_deg": 0.0, "depth_m": depth}
        result.planes.append({"condition": plane, "bias_px": 0.03, "sigma_m": None, "fill": 1.0})
        result.edge = {}
        (found,) = (v for v in bands.judge(result) if "bias" in v.band)
        assert found.passed is passed, found.measured


@pytest.mark.parametrize("bias_m", [(0.0,), (0.002, 0.003, 0.001)])
@pytest.mark.parametrize("baseline_m", [0.075, -0.075])
def test_a_fitted_preset_holds_its_bands(renderer, baseline_m, bias_m):
    sensor = replace(
        FITTED,
        baseline_m=baseline_m,
        bias_m=bias_m,
        noise_power=1.0,
        inverse_step_per_m=0.00575,
        depth_step_m=0.001,
        tilts_deg=(0.0, 30.0, 70.0),
        fill_rates=(0.97, 0.95, 0.6),  # a wall at 45 degrees has 82 %
        hole_px=1.0,
    )
    subject = Subject("my_d415", sensor)  # no preset of ours, whose bands go by its name
    assert subject.depths_m() == Subject("mine", replace(sensor, baseline_m=0.075)).depths_m()
    result = runner.SensorResult(subject, {})
    for depth, tilt in ((0.5, 0.0), (2.0, 0.0), (2.0, 45.0)):
        condition = planar.PlanarCondition(depth, tilt, phases=8, half_px=20)
        result.planes.append(planar.measure(subject, condition, renderer))
    result.edge = edges.measure(subject, edges.default_condition(subject, frames=1), renderer)
    found = bands.judge(result)
    assert [verdict for verdict in found if not verdict.passed] == []
    assert len(found) == 4
    # One that measures otherwise than it says fails.
    result.subject = Subject("mine", replace(sensor, bias_m=(0.05,), fill_rates=(0.97, 0.95, 0.9)))
    failed = " ".join(verdict.band for verdict in bands.judge(result) if not verdict.passed)
    assert "bias" in failed
    assert "fill" in failed


def test_silhouettes_are_the_same_for_a_projector_to_the_left():
    depth = np.full((40, 60), 2.5)
    depth[10:30, 20:40] = 1.5
    right = rooms.silhouettes(depth, 43.5)
    assert right.any()
    np.testing.assert_array_equal(rooms.silhouettes(depth, -43.5), right)
