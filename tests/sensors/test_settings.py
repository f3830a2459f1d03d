"""Settings that cannot be meant are refused, and the message names the key."""

import numpy as np
import pytest

from qs3.errors import ConfigError
from qs3.sensors.devices.blensor_kinect import DotMask
from qs3.sensors.devices.fitted import FittedDepth
from qs3.sensors.devices.fringe import FringeProjection
from qs3.sensors.devices.gaussian_time_of_flight import GaussianTimeOfFlight
from qs3.sensors.devices.reference_speckle import ReferenceSpeckle
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.devices.time_of_flight import TimeOfFlight
from qs3.sensors.matching import (
    CensusMatcher,
    NormalisedCorrelation,
    ReferenceMatcher,
    SemiGlobalMatcher,
    StereoBlockMatcher,
)
from qs3.sensors.matching.filters import FillHoles, Median, NeighbourCheck, Quantiser, SmallRegions
from qs3.sensors.optics.fringe_code import FringeCode
from qs3.sensors.optics.infrared import FilmicCamera, InfraredCamera
from qs3.sensors.optics.patterns import ReleasedSlide, Speckle
from qs3.sensors.renderers.base import Projector, Scene
from qs3.sensors.renderers.blender import BlenderRenderer
from qs3.sensors.renderers.mitsuba import MitsubaRenderer
from tests.sensors.renderers.scenes import wall

# What is made, its settings, and what the message says; by default the first setting's name.
WRONG = [
    (SpeckleStereo, {"baseline_m": 0.0}),
    (SpeckleStereo, {"sample_offset_px": 4}, r"in 0\.\.3"),
    (SpeckleStereo, {"blind_left_px": -1}),
    (SpeckleStereo, {"matcher": StereoBlockMatcher(80, 19)}, r"up to 78\.5 px, from 1\.92 m on"),
    (
        SpeckleStereo,
        {"matcher": CensusMatcher(64), "min_depth_m": 150 / 64},
        r"nearer than the matcher reaches.*up to 62\.5 px",
    ),
    (
        SpeckleStereo,
        {"matcher": StereoBlockMatcher(min_disparity=48)},
        r"max_depth_m 6\.0 is farther than .* from 48\.5 px on, up to 3\.09 m",
    ),
    (SpeckleStereo, {"quantiser": Quantiser(16)}, r"undoes sensor\.matcher\.remove_bias"),
    (
        ReferenceSpeckle,
        {"matcher": ReferenceMatcher(num_disparities=24)},
        r"the matcher finds -23\.5 to -1\.5",
    ),
    (DotMask, {"window_px": 8}, "window_px must be odd"),
    (DotMask, {"min_share": 1.0}),
    (DotMask, {"fill_px": -1.0}),
    (DotMask, {"step_px": 0}),
    (DotMask, {"min_depth_m": 9.0}),
    (DotMask, {"baseline_m": 0.0}),
    (FittedDepth, {"noise_factor": -1.0}),
    (FittedDepth, {"tilts_deg": (0.0, 10.0)}),
    (FittedDepth, {"fill_rates": (1.2,)}),
    (FittedDepth, {"tilts_deg": (10.0, 0.0), "fill_rates": (1.0, 1.0)}),
    (FittedDepth, {"min_depth_m": 9.0}),
    (FittedDepth, {"hole_px": -1.0}),
    (FittedDepth, {"step_px": 0}),
    (FringeCode, {"steps": 2}, "at least 3"),
    (FringeCode, {"periods": (1.0, 64.0, 8.0)}, "must increase"),
    (FringeCode, {"periods": (2.0, 8.0)}, "at most 1 period"),
    (FringeCode, {"periods": (1.0, 200.0)}, "at least 8 px"),
    (FringeProjection, {"max_misfit": 0.6}),
    (FringeProjection, {"baseline_m": 0.0}),
    (FringeProjection, {"min_depth_m": 7.0}),
    (TimeOfFlight, {"frequencies_hz": ()}),
    (TimeOfFlight, {"supersampling": 2}, "supersampling must be odd >= 1"),
    (TimeOfFlight, {"contrast": 1.2}),
    (TimeOfFlight, {"min_depth_m": 7.0}),
    (TimeOfFlight, {"read_noise_e": -1.0}),
    (GaussianTimeOfFlight, {"unambiguous_m": 0.0}),
    (StereoBlockMatcher, {"num_disparities": 50}),
    (StereoBlockMatcher, {"block_size": 10}),
    (SemiGlobalMatcher, {"num_disparities": 50}),
    (SemiGlobalMatcher, {"block_size": 4}),
    (SemiGlobalMatcher, {"mode": "fast"}),
    (SemiGlobalMatcher, {"p1": 100, "p2": 50}, "p1 < p2"),
    (NormalisedCorrelation, {"window_px": 4}),
    (ReferenceMatcher, {"num_disparities": 2}),
    (CensusMatcher, {"num_disparities": 2}),
    (CensusMatcher, {"window_px": 17}),
    (CensusMatcher, {"block_px": 4}),
    (CensusMatcher, {"block_px": 31}, "block_px 31 with costs"),
    (CensusMatcher, {"paths": 6}),
    (CensusMatcher, {"small_step": 50.0}),
    (CensusMatcher, {"difference_cap": -1}),
    (CensusMatcher, {"uniqueness_percent": -1.0}),
    (CensusMatcher, {"a_factor": 2.0}),
    (CensusMatcher, {"fit": "spline"}, "fit must be parabola or v, got 'spline'"),
    (Median, {"size_px": 4}),
    (NeighbourCheck, {"size_px": 2}),
    (NeighbourCheck, {"min_share": 1.5}),
    (SmallRegions, {"max_step_px": 0}),
    (FillHoles, {"max_width_px": 0}),
    (Quantiser, {"steps_per_px": -1}),
    (FilmicCamera, {"background": -1}, "background must be >= 0"),
    (FilmicCamera, {"faintest": 0}, "faintest must be > 0"),
    (InfraredCamera, {"white_level": 300.0}),
    (InfraredCamera, {"white_quantile": 0.0}),
    (InfraredCamera, {"speckle_contrast": 2.0}),
    (InfraredCamera, {"speckle_grain_px": 0}),
    (InfraredCamera, {"psf_px": -1.0}),
    (InfraredCamera, {"fixed_gain": 0.0}),
    (Speckle, {"fill": 0.2, "spacing": 1}, r"pattern\.fill 0\.2 cannot be reached with spacing 1"),
    (Speckle, {"spacing": -1}, r"pattern\.spacing must be >= 0"),
    (
        Speckle,
        {"fill": 4e-4, "columns": 40, "rows": 30},
        r"none of the 1200 positions.*above 0\.00042",
    ),
    (
        Speckle,
        {"fill": 0.6 / 15**2, "spacing": 14, "columns": 200, "rows": 150},
        r"spacing 14: of 80 dots of a tile \d\d found room",
    ),
    (ReleasedSlide, {"detail": 0}, r"pattern\.detail must be >= 1"),
    (ReleasedSlide, {"brightness_spread": 0.5}, "equally bright: leave pattern.brightness_spread"),
    (BlenderRenderer, {"samples": 0}),
    (MitsubaRenderer, {"samples": 0}),
    (Scene, {"bodies": ()}, "body"),
    (Scene, {"bodies": (wall(1.0),), "ambient": -0.1}, "ambient"),
    (wall, {"z_m": 1.0, "label": 256}, "label"),
    (
        Projector,
        {"world_from_projector": np.eye(4), "slide": np.ones((2, 2)), "tan_half_width": 1.0},
        "float32",
    ),
]


@pytest.mark.parametrize(
    ("make", "settings", "message"),
    [(make, settings, *(said or [next(iter(settings))])) for make, settings, *said in WRONG],
)
def test_wrong_settings_are_refused(make, settings, message):
    with pytest.raises(ConfigError, match=message):
        make(**settings)
