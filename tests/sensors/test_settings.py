"""Settings that cannot be meant are refused."""

import pytest

from qs3.sensors.devices.blensor_kinect import DotMask
from qs3.sensors.devices.fitted import FittedDepth
from qs3.sensors.devices.fringe import FringeCode, FringeProjection
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.devices.time_of_flight import TimeOfFlight
from qs3.sensors.matching import CensusMatcher, ReferenceMatcher, StereoBlockMatcher
from qs3.sensors.matching.filters import Quantiser
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.optics.patterns import Speckle
from qs3.sensors.renderers.blender_process import blender
from qs3.sensors.renderers.mitsuba import MitsubaRenderer

SPLIT = InfraredCamera(speckle_contrast=0.2, ambient_speckles=False)
WRONG = [
    (SpeckleStereo, {"baseline_m": 0.0}),
    (SpeckleStereo, {"sample_offset_px": 4}),
    (SpeckleStereo, {"matcher": StereoBlockMatcher(80, 19)}),  # too near for it
    (SpeckleStereo, {"matcher": StereoBlockMatcher(min_disparity=48)}),  # too far
    (SpeckleStereo, {"quantiser": Quantiser(16)}),  # would undo `remove_bias`
    (SpeckleStereo, {"misalignment": {"row_px": 0.2}}),
    (ReferenceSpeckle, {"matcher": ReferenceMatcher(num_disparities=24)}),
    (DotMask, {"window_px": 8}),
    (DotMask, {"min_depth_m": 9.0}),
    (FittedDepth, {"fill_rate": 1.1}),
    (FringeCode, {"periods": (1.0, 64.0, 8.0)}),
    (FringeCode, {"periods": (2.0, 8.0)}),
    (FringeCode, {"periods": (1.0, 200.0)}),
    (FringeProjection, {"infrared": SPLIT}),
    (TimeOfFlight, {"frequencies_hz": ()}),
    (StereoBlockMatcher, {"num_disparities": 50}),
    (ReferenceMatcher, {"window_px": 4}),
    (CensusMatcher, {"paths": 6}),
    (CensusMatcher, {"small_step": 50.0}),
    (CensusMatcher, {"block_px": 31}),  # its costs exceed 16 bits
    (InfraredCamera, {"metering": "centre"}),
    (blender, {"samples": 0}),
    (MitsubaRenderer, {"samples": 0}),
]


@pytest.mark.parametrize(("make", "settings"), WRONG)
def test_wrong_settings_are_refused(make, settings):
    with pytest.raises(ValueError, match="validation error"):
        make(**settings)


def test_dots_that_find_no_room_are_an_error():
    with pytest.raises(AssertionError, match="dots of 80"):
        _ = Speckle(fill=0.6 / 15**2, spacing=14, columns=200, rows=150).slide
