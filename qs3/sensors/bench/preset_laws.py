"""The axial noise that a sensor states itself, before a target of known albedo."""

from __future__ import annotations

from typing import Any

import numpy as np

from qs3.sensors.base import DepthFrame
from qs3.sensors.bench.targets import ALBEDO


def stated_sigma_m(sensor: Any, depth_m: float, frame: DepthFrame) -> float | None:
    """Standard deviation of the depth of a plane that faces the sensor, by the sensor's own law.

    Args:
        sensor: any; those that state no law give None.
        depth_m: of the plane, whose albedo is ALBEDO.
        frame: of that plane, for exposures that no one knows beforehand.
    """
    if hasattr(sensor, "noise_law_m"):
        return float(np.asarray(sensor.noise_law_m(depth_m)))
    if hasattr(sensor, "distance_sigma_m"):  # time of flight: light falls with the square
        lamp = sensor.electrons_at_1m * ALBEDO / depth_m**2
        mean = lamp + sensor.electrons_at_1m * ALBEDO * sensor.ambient
        return float(sensor.distance_sigma_m(sensor.contrast * lamp, mean))
    if hasattr(sensor, "depth_sigma_m") and "modulation" in frame.images:  # fringes
        modulation = float(np.median(frame.images["modulation"]))
        per_grey = sensor.infrared.electrons_at_white / 255
        mean_e = float(frame.images["exposures"].mean()) * per_grey
        shot_and_read = np.sqrt(mean_e + sensor.infrared.read_noise_e**2) / per_grey
        noise = float(np.hypot(shot_and_read, np.sqrt(1 / 12)))  # and whole grey values
        return float(sensor.depth_sigma_m(depth_m, noise, modulation))
    if hasattr(sensor, "noise_sigma_m"):
        return float(sensor.noise_sigma_m)
    return None
