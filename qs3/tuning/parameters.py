"""The numbers of a stereo sensor that are tuned, and the range that each may take."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from qs3.errors import ConfigError
from qs3.sensors.base import DepthSensor
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.optics.infrared import InfraredCamera

BOUNDS: Mapping[str, tuple[float, float]] = {
    "ambient": (0.003, 5.0),
    "infrared.psf_px": (0.2, 2.5),
    "infrared.electrons_at_white": (300.0, 30_000.0),
    "infrared.read_noise_e": (3.0, 300.0),
    "infrared.speckle_contrast": (0.02, 0.7),
    "infrared.white_level": (40.0, 250.0),
}
"""By the keys of the sensor's config. From a dark room to sunlight; from a sharp lens to one whose
dots run into each other; from a phone's pixels to an industrial camera's; from a broad laser with a
diffuser to fully developed speckle seen by a pixel (Landau, Choo and Betts, IEEE Trans. Cybernetics
2016, fitted 0.05 to 0.47); the exposure from a fifth of the range to where half of it clips."""

_SLACK = 1e-3  # of the logarithmic range: no search begins on a bound, where slopes vanish


def check_keys(keys: Sequence[str]) -> tuple[str, ...]:
    """The keys; ConfigError if one cannot be tuned, or none is given."""
    unknown = [key for key in keys if key not in BOUNDS]
    if unknown or not keys:
        raise ConfigError(
            f"parameters={','.join(keys)}: {unknown[0] if unknown else 'none'} cannot be tuned; "
            f"choose among {', '.join(BOUNDS)}"
        )
    return tuple(dict.fromkeys(keys))


def check_sensor(sensor: DepthSensor) -> SpeckleStereo:
    """The sensor; ConfigError if the differentiable twin does not know its kind."""
    if not isinstance(sensor, SpeckleStereo) or not isinstance(sensor.infrared, InfraredCamera):
        raise ConfigError(
            "only active stereo sensors with a linear infrared camera can be tuned: take "
            "sensor=speckle_stereo, realsense_d415 or another of the kind, and leave released= out"
        )
    return sensor


def values_of(sensor: SpeckleStereo, keys: Sequence[str]) -> dict[str, float]:
    """What a sensor has."""
    out = {}
    for key in keys:
        found: object = sensor
        for word in key.split("."):
            found = getattr(found, word)
        assert isinstance(found, int | float)
        out[key] = float(found)
    return out


def with_values(sensor: SpeckleStereo, values: Mapping[str, float]) -> SpeckleStereo:
    """The sensor with other numbers."""
    inside: Any = {k.partition(".")[2]: v for k, v in values.items() if k.startswith("infrared.")}
    own: Any = {key: value for key, value in values.items() if "." not in key}
    return replace(sensor, infrared=replace(sensor.infrared, **inside), **own)


def free(values: Mapping[str, float]) -> np.ndarray:
    """[K] any real number for each value: the logit of its place in the range's logarithm."""
    out = []
    for key, value in values.items():
        low, high = BOUNDS[key]
        place = math.log(max(value, 1e-12) / low) / math.log(high / low)
        place = min(max(place, _SLACK), 1 - _SLACK)
        out.append(math.log(place / (1 - place)))
    return np.array(out)


def bounded(numbers: torch.Tensor, keys: Sequence[str]) -> dict[str, torch.Tensor]:
    """The values of free numbers [K], with gradients; the inverse of `free`."""
    out = {}
    for key, number in zip(keys, numbers, strict=True):
        low, high = BOUNDS[key]
        out[key] = low * (high / low) ** torch.sigmoid(number)
    return out


def as_floats(values: Mapping[str, torch.Tensor]) -> dict[str, float]:
    """Without gradients."""
    return {key: float(value.detach()) for key, value in values.items()}
