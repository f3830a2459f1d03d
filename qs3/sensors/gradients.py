"""The speckle-stereo sensor in torch: images, exposure, matching and depth with gradients.

The scene is fixed (`Twin`: a plane for each pixel), so gradients hold away from silhouettes
and shadow edges, which a change of the baseline would move. Everything else is the formula of the
ordinary sensor: `renderers.base` for the projector's light, `optics.infrared` for the exposure.
The matcher is normalised correlation with a soft argmax (Kendall et al., GC-Net, ICCV 2017,
section 3.4) near the best whole disparity; grey values are not rounded.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F

from qs3.geometry.cameras import Camera, Window
from qs3.sensors.base import window_of
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.optics.visibility import reached_from
from qs3.sensors.renderers.base import Body, Renderer, Scene, tangents

Settings = Mapping[str, torch.Tensor]
"""Numbers (0-d tensors) by the keys of the sensor's config: see `settings_of`."""

_BEND = 1e-3  # of 1 / Z, second difference over neighbours: more is an edge
_REACH = 4.0  # of the lens's Gaussian, in standard deviations
_BLOCK_PX = 15  # side of the blocks that are compared
_STEPS = 4  # of the disparity to a pixel
_NEAR = 4  # of these steps to each side of the best one
_SHARPNESS = 80.0  # of the soft argmax, per unit of correlation


@dataclass(frozen=True)
class View:
    """One camera's pixels: tensors [h, w] float64.

    Attributes:
        window: which pixels of the whole image.
        plane: [h, w, 3] (a, b, c) of the surface: 1 / Z = a x + b y + c with x, y the tangents
            of a ray; in the camera's axes and metres; 0 where nothing is.
        albedo: mean over the pixel; 0 where nothing is.
        lit: 1 where the projector reaches a part of the pixel, else 0.
        smooth: bool; the surface goes on in all four directions, so it is no silhouette.
    """

    window: Window
    plane: torch.Tensor
    albedo: torch.Tensor
    lit: torch.Tensor
    smooth: torch.Tensor


@dataclass(frozen=True)
class Twin:
    """A differentiable speckle-stereo sensor in front of one scene.

    Attributes:
        sensor: whose formulas these are; `left` and `right` are seen at its own settings.
        fine: samples along each side of a pixel; 4 is the 16 samples of the renderers.
    """

    sensor: SpeckleStereo
    left: View
    right: View
    fine: int = 4

    def radiance(self, settings: Settings, which: int) -> torch.Tensor:
        """Image [h, w] float64 of the left (0) or right (1) camera before the lens."""
        sensor, view = self.sensor, (self.left, self.right)[which]
        window, k = view.window, sensor.intrinsics
        focal, baseline = settings["focal_px"], settings["baseline_m"]
        slide = torch.from_numpy(sensor.pattern.slide.astype("float64"))
        a, b, c = view.plane.unbind(-1)
        # The surface stays where it is when the right camera moves along x.
        moved = (baseline - sensor.baseline_m) * which
        rest = 1 - a * moved
        a, b, c = a / rest, b / rest, c / rest
        to_projector = baseline / 2 - baseline * which
        length = torch.sqrt(a * a + b * b + c * c + 1e-12)
        total = torch.zeros_like(view.albedo)
        offsets = [(i + 0.5) / self.fine - 0.5 for i in range(self.fine)]
        u = window.left + torch.arange(window.width, dtype=torch.float64) - k.cx_px
        v = (window.top + torch.arange(window.height, dtype=torch.float64) - k.cy_px)[:, None]
        there = view.albedo > 0
        for dv in offsets:
            for du in offsets:
                x, y = (u + du) / focal, (v + dv) / focal
                inverse = a * x + b * y + c
                inverse = torch.where(there & (inverse > 1e-6), inverse, 1.0)
                z = 1 / inverse
                px, py = to_projector - x * z, -y * z
                facing = torch.abs(a * px + b * py - c * z) / length
                light = _slide_at(slide, -px / z, -py / z, sensor.tan_half_width)
                total = total + light * facing / z**3
        projected = settings["projector_strength"] * view.lit * total / self.fine**2
        return settings["albedo"] * view.albedo * (settings["ambient"] + projected)

    def grey(
        self, settings: Settings, noise: torch.Generator | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Both exposures [h, w] float64, 0..255; see `exposed`."""
        camera, light = self.sensor.infrared, settings["albedo"] * settings["ambient"]
        assert isinstance(camera, InfraredCamera)
        left, right = (
            exposed(camera, self.radiance(settings, which), light * view.albedo, settings, noise)
            for which, view in enumerate((self.left, self.right))
        )
        return left, right

    def disparity(
        self, left: torch.Tensor, right: torch.Tensor, lowest: int, highest: int
    ) -> torch.Tensor:
        """[h, w] float64 disparity in px of the left image's pixels.

        Correlated are blocks at `lowest` to `highest` in quarters, by the cubic of Catmull and Rom;
        what is outside is dark. The best place is chosen without a gradient.
        """
        offset = self.left.window.left - self.right.window.left
        t = torch.arange(1 - 2 * _STEPS, 2 * _STEPS, dtype=right.dtype).abs() / _STEPS
        near, far = 1 - 2.5 * t**2 + 1.5 * t**3, 2 - 4 * t + 2.5 * t**2 - 0.5 * t**3
        cubic = torch.where(t < 1, near, far)[None, None]
        padding = 2 * _STEPS - 1
        fine = F.conv_transpose1d(right[:, None], cubic, stride=_STEPS, padding=padding)[:, 0]
        # Column u of `left` is column u + offset - d of `right`.
        begin = (offset - highest) * _STEPS
        end = (offset - lowest + left.shape[1]) * _STEPS
        before = max(0, -begin)
        fine = F.pad(fine, (before, max(0, end - fine.shape[1])))[:, before + begin :]
        mean_left = _block_mean(left)
        spread_left = _block_mean(left * left) - mean_left**2
        found = []
        for place in reversed(range((highest - lowest) * _STEPS + 1)):
            other = fine[:, place::_STEPS][:, : left.shape[1]]
            mean = _block_mean(other)
            spread = spread_left * (_block_mean(other * other) - mean**2)
            shared = _block_mean(left * other) - mean_left * mean
            found.append(shared / torch.sqrt(spread.clamp_min(1e-6)))
        score = torch.stack(found)
        step = torch.arange(len(score), dtype=score.dtype)[:, None, None]
        best = score.detach().argmax(dim=0).clamp(_NEAR, len(score) - 1 - _NEAR)
        close = (step - best).abs() <= _NEAR
        weight = torch.softmax(torch.where(close, _SHARPNESS * score, -torch.inf), dim=0)
        return lowest + (weight * step).sum(dim=0) / _STEPS


def twin_of(
    sensor: SpeckleStereo,
    bodies: tuple[Body, ...],
    box_m: np.ndarray,
    world_from_camera: np.ndarray,
    renderer: Renderer,
) -> Twin:
    """The twin of a sensor in front of matt bodies.

    `box_m` [2, 3] of the world limits the pixels, `world_from_camera` [4, 4] is the pose of the
    left camera, and the renderer gives geometry, albedo and shadows.
    """
    assert all(body.gloss is None for body in bodies), "the twin has matt bodies only"
    whole = Camera(sensor.intrinsics, world_from_camera)
    projector = whole.moved((sensor.baseline_m / 2, 0, 0)).world_from_camera
    views = []
    for shift in (0.0, sensor.baseline_m):
        camera = whole.moved((shift, 0, 0))
        window = window_of(box_m, camera, margin_px=sensor.margin_px)
        assert window is not None, "the box is outside the view of one of the cameras"
        camera = replace(camera, window=window)
        (even,) = renderer.render(Scene(bodies, None, 1.0), [camera], seed=0, geometry=[True])
        plane, smooth = _planes(even.depth_m, camera)
        albedo = np.where(np.isfinite(even.depth_m), even.radiance, 0).astype(np.float64)
        lit = reached_from(bodies, camera, projector, renderer).astype(np.float64)
        views.append(View(window, *map(torch.from_numpy, (plane, albedo, lit, smooth))))
    return Twin(sensor, views[0], views[1])


def _planes(depth_m: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """`View.plane` and `View.smooth`; at an edge the surface faces the camera."""
    inverse = 1 / depth_m.astype(np.float64)  # 0 where nothing is
    wide = np.pad(inverse, 1)
    left, right, above, below = wide[1:-1, :-2], wide[1:-1, 2:], wide[:-2, 1:-1], wide[2:, 1:-1]
    bend = np.maximum(np.abs(left + right - 2 * inverse), np.abs(above + below - 2 * inverse))
    smooth = bend < _BEND * inverse
    a, b = (
        np.where(smooth, slope / 2, 0) * camera.intrinsics.focal_px
        for slope in (right - left, below - above)
    )
    x, y = tangents(camera)
    return np.stack([a, b, inverse - a * x - b * y], axis=-1), smooth


def settings_of(sensor: SpeckleStereo, gain: float) -> dict[str, torch.Tensor]:
    """The sensor's own numbers, `gain` in grey values per radiance, and a factor of all albedos."""
    camera = sensor.infrared
    assert isinstance(camera, InfraredCamera)
    numbers = {
        "projector_strength": sensor.projector_strength,
        "ambient": sensor.ambient,
        "baseline_m": sensor.baseline_m,
        "focal_px": sensor.focal_px,
        "gain": gain,
        "infrared.psf_px": camera.psf_px,
        "infrared.electrons_at_white": camera.electrons_at_white,
        "infrared.read_noise_e": camera.read_noise_e,
        "infrared.speckle_contrast": camera.speckle_contrast,
        "albedo": 1.0,
    }
    return {key: torch.tensor(float(value), dtype=torch.float64) for key, value in numbers.items()}


def exposed(
    camera: InfraredCamera,
    radiance: torch.Tensor,
    ambient: torch.Tensor,
    settings: Settings,
    noise: torch.Generator | None,
) -> torch.Tensor:
    """[h, w] grey values 0..255, as by `camera.expose`, with `settings` in place of its numbers.

    `ambient` [h, w] is the part of `radiance` that is not the projector's. `noise` is of speckle,
    photons and read-out; None: none.
    """
    contrast = settings["infrared.speckle_contrast"]
    if noise is not None and float(contrast.detach()) > 0:
        grains = _gamma_like(radiance, contrast, noise)
        even = 0 if camera.ambient_speckles else ambient
        radiance = even + (radiance - even) * grains
    image = blurred(radiance, settings["infrared.psf_px"])
    per_grey = settings["infrared.electrons_at_white"] / 255
    if camera.max_exposure is not None:
        per_grey = per_grey / (settings["gain"] / camera.max_exposure).clamp_min(1)
    electrons = image * settings["gain"] * per_grey
    if noise is not None:
        variance = electrons.clamp_min(0) + settings["infrared.read_noise_e"] ** 2
        spread = torch.sqrt(variance + 1e-9)  # the root of 0 has no gradient
        drawn = torch.randn(electrons.shape, generator=noise, dtype=electrons.dtype)
        electrons = electrons + spread * drawn
    return (electrons / per_grey).clamp(0, 255)


def _slide_at(
    slide: torch.Tensor, x: torch.Tensor, y: torch.Tensor, tan_half_width: float
) -> torch.Tensor:
    """[h, w] brightness in direction (x, y, 1), linear between the slide's pixels; 0 outside."""
    rows, columns = slide.shape
    place_x = x / tan_half_width
    place_y = y / (tan_half_width * rows / columns)
    grid = torch.stack([place_x, place_y], dim=-1)[None]
    inside = (place_x.abs() <= 1) & (place_y.abs() <= 1)
    picture = slide[None, None].to(grid.dtype)
    found = F.grid_sample(picture, grid, padding_mode="border", align_corners=False)[0, 0]
    return found * inside


def blurred(image: torch.Tensor, sigma_px: torch.Tensor) -> torch.Tensor:
    """[h, w] through a Gaussian whose width may want a gradient; 0 outside the image."""
    if float(sigma_px.detach()) <= 0:
        return image
    reach = max(1, math.ceil(_REACH * float(sigma_px.detach())))
    place = torch.arange(-reach, reach + 1, dtype=sigma_px.dtype)
    kernel = torch.exp(-(place**2) / (2 * sigma_px**2))
    kernel = (kernel / kernel.sum()).to(image.dtype)
    rows = F.conv2d(image[None, None], kernel[None, None, None], padding=(0, reach))
    return F.conv2d(rows, kernel[None, None, :, None], padding=(reach, 0))[0, 0]


def _gamma_like(
    image: torch.Tensor, contrast: torch.Tensor, noise: torch.Generator
) -> torch.Tensor:
    """Gamma variables with mean 1, whose gradient by the contrast is an implicit one."""
    shape = 1 / contrast**2
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**31, (), generator=noise)))
        return torch.distributions.Gamma(shape, shape).rsample(image.shape)


def _block_mean(image: torch.Tensor) -> torch.Tensor:
    """[h, w] mean over what is inside the image of the block around each pixel."""
    half = _BLOCK_PX // 2
    return F.avg_pool2d(image[None], _BLOCK_PX, 1, half, count_include_pad=False)[0]
