"""The infrared images of an active stereo camera: what can be held against a real device's.

Measured on the left image of a plane that faces the camera, as from a pair of pictures with and
without the projector at the same exposure. See `laws.REAL_D415` for a device's figures.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np

from qs3.calibration.bench.planar import take, without_nan
from qs3.calibration.bench.subject import Subject
from qs3.calibration.bench.targets import TiltedPlane
from qs3.errors import ConfigError
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.renderers.base import Renderer

BRIGHTEST = 0.99
"""Quantile that stands for the brightest dots."""

_SMOOTH_PX = 10.0
_DIM = 1e-6  # of the projector's light: switched off


@dataclass(frozen=True)
class InfraredCondition:
    """A plane that faces the camera.

    Attributes:
        depth_m: where. The device's pictures show things on a table, at about this distance.
        half_px: half the side of the region.
    """

    depth_m: float = 1.0
    half_px: int = 60

    @property
    def name(self) -> str:
        """For file names and messages."""
        return f"infrared-{self.depth_m:g}m"


def applies(subject: Subject) -> bool:
    """Whether a sensor takes a pair of infrared pictures by a camera of known noise."""
    sensor = subject.sensor
    return isinstance(sensor, SpeckleStereo) and isinstance(sensor.infrared, InfraredCamera)


def measure(
    subject: Subject, condition: InfraredCondition, renderer: Renderer, seed: int = 0
) -> dict[str, Any]:
    """Render and measure.

    Returns:
        contrast: median over the pixels of standard deviation / mean of the 9 x 9 window.
        autocorrelation: of pixels 1, 2 and 3 px apart along a row; see `autocorrelation`.
        dots_over_ambient: the projector's light where it is brightest (a quantile of
            `BRIGHTEST`) over the light without it, both without noise.
        grey: mean grey value.
    """
    sensor = subject.sensor
    if not applies(subject):
        raise ConfigError(f"sensor={subject.name} takes no pair of infrared images")
    assert isinstance(sensor, SpeckleStereo)
    assert isinstance(sensor.infrared, InfraredCamera)

    def picture(of: SpeckleStereo) -> np.ndarray:
        looking = replace(subject, sensor=of)
        plane = TiltedPlane(condition.depth_m, centre_px=(7.3, -5.1))
        rng = np.random.default_rng([0x1F4A, seed])
        frame, part = take(looking, plane, condition.half_px, renderer, rng)
        return frame.images["left"][part].astype(np.float64)

    grey = picture(sensor)
    # One gain for both pictures: that of the brightest, found by an exposure that is too short.
    quiet = replace(sensor.infrared, electrons_at_white=1e9, read_noise_e=0.0, fixed_gain=1.0)
    quiet = replace(quiet, speckle_contrast=0.0)
    level = np.quantile(picture(replace(sensor, infrared=quiet)), BRIGHTEST)
    quiet = replace(quiet, fixed_gain=sensor.infrared.white_level / max(float(level), 1.0))
    lit = replace(sensor, infrared=quiet)
    on = picture(lit)
    off = picture(replace(lit, projector_strength=sensor.projector_strength * _DIM))
    ambient = max(float(off.mean()), 0.5)  # half a grey value: what cannot be told from none
    return without_nan(
        {
            "condition": asdict(condition),
            "contrast": contrast(grey),
            "autocorrelation": [autocorrelation(grey, lag) for lag in (1, 2, 3)],
            "dots_over_ambient": float(np.quantile(on - off, BRIGHTEST)) / ambient,
            "grey": float(grey.mean()),
        }
    )


def contrast(grey: np.ndarray, window_px: int = 9) -> float:
    """Median of standard deviation / mean over the windows that lie in [h, w] as a whole."""
    size, half = (window_px, window_px), window_px // 2
    mean = cv2.blur(grey, size)
    square = cv2.blur(grey * grey, size)
    inner = (slice(half, -half or None),) * 2
    spread = np.sqrt(np.maximum(square - mean**2, 0))[inner]
    return float(np.median(spread / np.maximum(mean[inner], 1e-3)))


def autocorrelation(grey: np.ndarray, lag_px: int) -> float:
    """Of pixels of [h, w] `lag_px` apart along a row, without shading (a Gaussian of 10 px)."""
    flat = grey - cv2.GaussianBlur(grey, (0, 0), _SMOOTH_PX)
    return float((flat[:, lag_px:] * flat[:, :-lag_px]).mean() / max((flat**2).mean(), 1e-12))
