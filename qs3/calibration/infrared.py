"""Ambient light, blur and read noise of a stereo preset, from infrared pictures, by gradient.

The dots of a real projector are not ours, so pictures are compared by what does not depend on
where dots lie (`statistics`). The differentiable twin of the preset makes pictures of the same
wall, with fixed random numbers for the noise, and least squares follows its gradients.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.optimize import least_squares

from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.errors import ConfigError, DataError
from qs3.geometry.cameras import Window
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.gradients import Twin, View, blurred, exposed, settings_of
from qs3.sensors.optics.infrared import InfraredCamera

KEYS = ("ambient", "infrared.psf_px", "infrared.read_noise_e")
_SMOOTH_PX = 12.0  # standard deviation of the Gaussian that is taken for shading
_LAGS = 4
_ERROR = 0.02  # by which statistics of pictures of other dots differ, relative


def statistics(grey: torch.Tensor) -> torch.Tensor:
    """[1 + _LAGS] covariances of pixels 0, 1, 2, ... apart, over rows and columns.

    Of [h, w] grey values relative to the local mean. Neighbours share texture and no noise.
    """
    mean = blurred(grey, torch.tensor(_SMOOTH_PX, dtype=grey.dtype))
    frame = int(4 * _SMOOTH_PX)  # the shading is not known there
    texture = (grey / mean.clamp_min(1e-9) - 1)[frame:-frame, frame:-frame]
    high, wide = texture.shape
    covariances = [
        (texture[:, lag:] * texture[:, : wide - lag]).mean()
        + (texture[lag:] * texture[: high - lag]).mean()
        for lag in range(1 + _LAGS)
    ]
    return torch.stack(covariances)


def fit_light(
    base: SpeckleStereo, lit: Sequence[np.ndarray], dark: Sequence[np.ndarray], distance_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Values of `KEYS`, and relative standard errors by the curvature of the fit.

    Args:
        base: the preset to begin with; pattern, projector, geometry and electrons stay.
        lit, dark: [h, w] grey values 0..255 of a wall that faces the cameras, with the projector on
            and off at the same exposure, a picture a camera.
        distance_m: of the wall.
    """
    pairs = [[torch.from_numpy(image) for image in pair] for pair in zip(lit, dark, strict=True)]
    wanted = torch.stack([_compared(*pair) for pair in pairs]).mean(dim=0)
    start = settings_of(base, 1.0)
    camera = base.infrared
    assert isinstance(camera, InfraredCamera), "the base has no linear camera"
    with torch.no_grad():
        light = start | {"ambient": torch.zeros(())}
        projected = _facing(base, distance_m).radiance(light, 0)
    off_grey = float(np.mean([image.mean() for image in dark]))
    first = [max(float(start[key]), least) for key, least in zip(KEYS, (0.01, 0.3, 1), strict=True)]

    def residuals(logs: torch.Tensor) -> torch.Tensor:
        numbers = dict(zip(KEYS, torch.tensor(first) * torch.exp(logs), strict=True))
        settings = start | numbers | {"gain": off_grey / numbers["ambient"]}
        even = numbers["ambient"].expand(projected.shape)
        noise = torch.Generator().manual_seed(0)
        on = exposed(camera, even + projected, even, settings, noise)
        off = exposed(camera, even, even, settings, noise)
        return (_compared(on, off) / wanted - 1) / _ERROR

    jacobian = torch.autograd.functional.jacobian
    solved = least_squares(
        lambda logs: residuals(torch.from_numpy(logs)).numpy(),
        np.zeros(len(KEYS)),
        jac=lambda logs: jacobian(residuals, torch.from_numpy(logs)).numpy(),
        bounds=(-4, 4),
        x_scale=0.5,
    )
    values = np.array(first) * np.exp(solved.x)
    return values, np.sqrt(np.diag(np.linalg.pinv(solved.jac.T @ solved.jac)))


def _compared(on: torch.Tensor, off: torch.Tensor) -> torch.Tensor:
    """[3 + _LAGS] what is compared: mean light, covariances, and the variance in the dark."""
    light = (on.mean() / off.mean() - 1)[None]
    return torch.cat([light, statistics(on), statistics(off)[:1]])


def _facing(base: SpeckleStereo, distance_m: float) -> Twin:
    """A white plane that faces the cameras, a square of pixels in the middle of the view."""
    k, side = base.intrinsics, 320
    window = Window((k.width_px - side) // 2, (k.height_px - side) // 2, side, side)
    one = torch.ones(side, side, dtype=torch.float64)
    plane = torch.stack([0 * one, 0 * one, one / distance_m], dim=-1)
    view = View(window, plane, one, one, one > 0)
    return Twin(base, view, view, fine=3)


def fit_pictures(folder: Path, base: str, distance_m: float) -> str:
    """Fit the preset `base` to the pictures of a folder; returns the new preset as YAML.

    Files are left.png and left_off.png, and right.png and right_off.png where there are any.
    """
    sensor = build(composed(None, f"+sensor={base}").sensor)
    if not isinstance(sensor, SpeckleStereo):
        raise ConfigError(f"base={base} is not an active stereo camera")
    sides = ["left", "right"] if (folder / "right.png").exists() else ["left"]
    lit = [_grey(folder / f"{side}.png") for side in sides]
    dark = [_grey(folder / f"{side}_off.png") for side in sides]
    values, errors = fit_light(sensor, lit, dark, distance_m)
    lines = [
        f"{key.split('.')[-1]}: {value:.6g}  # +- {error:.1%}"
        for key, value, error in zip(KEYS, values, errors, strict=True)
    ]
    return f"""\
# Fitted to infrared pictures of a wall at {distance_m:g} m.
defaults:
  - {base}
  - _self_

{lines[0]}
infrared:
  {lines[1]}
  {lines[2]}
"""


def _grey(path: Path) -> np.ndarray:
    """[h, w] float64, 0..255, of a picture of 8 or 16 bits."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if image is None:
        raise DataError(f"{path} cannot be read as a picture")
    return image.astype(np.float64) / (257 if image.dtype == np.uint16 else 1)
