"""Time of flight in the manner of BlenSor: the true distance plus noise of one size.

Gschwandtner et al., "BlenSor: Blender Sensor Simulation Toolbox", 2011: a ray a pixel, a normal
error on the distance, and, if wanted, distances folded back into the range that one modulation
frequency can tell apart. For physics see qs3.sensors.devices.time_of_flight.
"""

from typing import ClassVar

import numpy as np

from qs3.sensors.base import DepthFrame, DepthSensor, Shot
from qs3.sensors.optics.visibility import Reason, first_reason
from qs3.sensors.renderers.base import tangents
from qs3.utils.settings import Count, NotNegative, Positive, settings


@settings
class GaussianTimeOfFlight(DepthSensor):
    """Distance with a normal error.

    The defaults are BlenSor's for the SwissRanger SR4000: 176 x 144 px over 43.6 degrees, mean
    0 and sigma 4 mm, 20 m reach, no back-folding; the device's first model is unambiguous up to
    5 m.

    Attributes:
        step_px: every step-th pixel of every step-th row gives a depth, the middle of each step.
        noise_mean_m, noise_sigma_m: of the error of the distance along the ray.
        backfolding: distances are known only modulo `unambiguous_m`.
        unambiguous_m: c / (2 f) of the device.
        max_distance_m: surfaces further away give nothing.
    """

    sees_light: ClassVar[bool] = False
    width_px: Count = 176
    height_px: Count = 144
    focal_px: Positive = 220.0
    step_px: Count = 1
    noise_mean_m: float = 0.0
    noise_sigma_m: NotNegative = 0.004
    backfolding: bool = False
    unambiguous_m: Positive = 5.0
    max_distance_m: Positive = 20.0

    def take(self, shot: Shot) -> DepthFrame:
        """See `DepthSensor.take`. There is nothing to explain."""
        image, at = shot.image(), shot.samples(self.step_px)
        x, y = tangents(shot.camera)
        clean, length = at.of(image.depth_m), at.of(np.sqrt(1 + x * x + y * y))
        distance = clean.astype(np.float64) * length
        error = self.noise_mean_m + self.noise_sigma_m * shot.rng.standard_normal(clean.shape)
        found = distance + error
        if self.backfolding:
            with np.errstate(invalid="ignore"):
                found = found % self.unambiguous_m
        hit = np.isfinite(clean)
        reached = hit & (distance <= self.max_distance_m)
        reason = first_reason({Reason.OK: reached, Reason.RANGE: hit}, Reason.EMPTY)
        depth = np.where(reached, found / length, np.nan).astype(np.float32)
        return shot.frame(depth, reason, image, {"clean": image.depth_m}, at)
