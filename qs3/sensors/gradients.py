"""The speckle-stereo sensor in torch: images, exposure, matching and depth with gradients.

The scene is fixed (`Pair`: a plane for each pixel), so gradients hold away from silhouettes
and shadow edges, which a change of the baseline would move. Everything else is the formula of the
ordinary sensor: `renderers.base` for the projector's light, `optics.infrared` for the exposure.
Hard choices have soft ones in their place: the matcher is normalised correlation with a
soft argmax (Kendall et al., GC-Net, ICCV 2017, section 3.4) near the best whole disparity, and
rounding to grey values passes gradients through.
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
from qs3.sensors.renderers.base import Body, Image, Projector, Renderer, Scene, tangents

_BEND = 1e-3  # of 1 / Z, second difference over neighbours: more is an edge


@dataclass(frozen=True)
class View:
    """One camera's pixels: tensors [h, w] float64.

    Attributes:
        window: which pixels of the whole image.
        plane: [h, w, 3] (a, b, c) of the surface: 1 / Z = a x + b y + c with x, y the tangents
            of a ray; in the camera's axes and metres; 0 where nothing is.
        albedo: mean over the pixel; 0 where nothing is.
        lit: share of the pixel that the projector reaches.
        smooth: bool; the surface goes on in all four directions, so it is no silhouette.
    """

    window: Window
    plane: torch.Tensor
    albedo: torch.Tensor
    lit: torch.Tensor
    smooth: torch.Tensor


@dataclass(frozen=True)
class Pair:
    """The views of both cameras of a sensor, at its own settings."""

    sensor: SpeckleStereo
    left: View
    right: View


def pair_of(
    sensor: SpeckleStereo,
    bodies: tuple[Body, ...],
    box_m: np.ndarray,
    world_from_camera: np.ndarray,
    renderer: Renderer,
) -> Pair:
    """Render what the twin of a sensor needs of a scene of matt bodies.

    `box_m` [2, 3] of the world limits the pixels, `world_from_camera` [4, 4] is the pose of the
    left camera, and the renderer gives geometry, albedo and shadows.
    """
    assert all(body.gloss is None for body in bodies), "the twin has matt bodies only"
    k = sensor.intrinsics
    whole = Camera(k, world_from_camera)
    views = []
    centre = whole.moved((sensor.baseline_m / 2, 0, 0)).world_from_camera
    white = Projector(centre, np.ones((4, 4), np.float32), 10.0, strength=1.0)
    for shift in (0.0, sensor.baseline_m):
        camera = whole.moved((shift, 0, 0))
        window = window_of(box_m, camera, margin_px=sensor.margin_px)
        assert window is not None, "the box is outside the view of one of the cameras"
        camera = replace(camera, window=window)
        (even,) = renderer.render(Scene(bodies, None, 1.0), [camera], seed=0, geometry=[True])
        (lit,) = renderer.render(Scene(bodies, white), [camera], seed=0, geometry=[False])
        views.append(_view(camera, even, lit.radiance, sensor.baseline_m / 2 - shift))
    return Pair(sensor, *views)


def _view(camera: Camera, even: Image, lit: np.ndarray, projector_x: float) -> View:
    x, y = tangents(camera)
    f = camera.intrinsics.focal_px
    with np.errstate(divide="ignore"):
        inverse = np.where(np.isfinite(even.depth_m), 1 / even.depth_m.astype(np.float64), np.nan)
    slopes, smooth = [], np.isfinite(inverse)
    for axis in (1, 0):
        before, after = (_shifted(inverse, axis, step) for step in (1, -1))
        with np.errstate(invalid="ignore"):
            bend = np.abs(before + after - 2 * inverse) / inverse
        smooth &= bend < _BEND
        # At an edge the side that bends less goes on; alone, a surface that faces the camera.
        sides = np.stack([inverse - before, after - inverse])
        least = np.nanmin(np.where(np.isnan(sides), np.inf, np.abs(sides)), axis=0)
        one = np.where(np.abs(sides[0]) == least, sides[0], sides[1])
        slope = np.where(bend < _BEND, (after - before) / 2, one)
        slopes.append(np.nan_to_num(slope) * f)
    a, b = slopes
    plane = np.stack([a, b, inverse - a * x - b * y], axis=-1)
    there = np.isfinite(inverse)
    plane = np.where(there[..., None], plane, 0)
    albedo = np.where(there, even.radiance, 0).astype(np.float64)
    # What a projector of strength 1 without a slide gives it, over what is seen of it.
    with np.errstate(divide="ignore", invalid="ignore"):
        z = 1 / inverse
        normal = plane / np.linalg.norm(plane, axis=-1, keepdims=True)
        px, py = projector_x - x * z, -y * z
        facing = np.abs(normal[..., 0] * px + normal[..., 1] * py - normal[..., 2] * z)
        share = lit / (albedo * facing / z**3)
    share = np.clip(np.nan_to_num(share, posinf=0.0), 0, 1)
    tensors = (plane, albedo, share, smooth)
    return View(camera.rendered, *(torch.from_numpy(np.ascontiguousarray(t)) for t in tensors))


def _shifted(image: np.ndarray, axis: int, step: int) -> np.ndarray:
    """The neighbour before (step 1) or after (-1) along an axis; NaN outside."""
    out = np.roll(image, step, axis=axis)
    edge: list[slice | int] = [slice(None), slice(None)]
    edge[axis] = 0 if step > 0 else -1
    out[tuple(edge)] = np.nan
    return out


_REACH = 4.0  # of the lens's Gaussian, in standard deviations
STEPS = 4
"""Of the disparity to a pixel, at which blocks are compared."""

_NEAR = 4  # of these steps to each side of the best one

Settings = Mapping[str, torch.Tensor]
"""Numbers (0-d tensors) by the keys of the sensor's config: see `settings_of`."""


def settings_of(pair: Pair, gain: float) -> dict[str, torch.Tensor]:
    """The sensor's own numbers, `gain` in grey values per radiance, and a factor of all albedos."""
    sensor, camera = pair.sensor, pair.sensor.infrared
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


@dataclass(frozen=True)
class Twin:
    """A differentiable speckle-stereo sensor in front of one scene.

    Attributes:
        pair: what its cameras see.
        fine: samples along each side of a pixel; 4 is the 16 samples of the renderers.
        slide: [H, W] float64 in 0..1; None: the sensor's.
    """

    pair: Pair
    fine: int = 4
    slide: torch.Tensor | None = None

    def radiance(self, settings: Settings) -> tuple[torch.Tensor, torch.Tensor]:
        """Both images [h, w] float64 before the lens, over the windows of the views."""
        return self._seen(self.pair.left, settings, 0), self._seen(self.pair.right, settings, 1)

    def _seen(self, view: View, settings: Settings, which: int) -> torch.Tensor:
        sensor, window = self.pair.sensor, view.window
        k = sensor.intrinsics
        focal, baseline = settings["focal_px"], settings["baseline_m"]
        slide = self.slide
        if slide is None:
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
        self, settings: Settings, noise: torch.Generator | None = None, whole: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Both exposures [h, w] float64, 0..255.

        `noise` is of speckle, photons and read-out; None: none, and no rounding either. If `whole`,
        noisy images are rounded to grey values; gradients pass as if they were not.
        """
        camera = self.pair.sensor.infrared
        assert isinstance(camera, InfraredCamera)
        light, pictures = settings["albedo"] * settings["ambient"], []
        views = (self.pair.left, self.pair.right)
        for image, view in zip(self.radiance(settings), views, strict=True):
            even = None if camera.ambient_speckles else light * view.albedo
            pictures.append(exposed(image, settings, noise, whole, even, camera.max_exposure))
        return pictures[0], pictures[1]

    def disparity(
        self,
        left: torch.Tensor,
        right: torch.Tensor,
        lowest: int,
        highest: int,
        block_px: int = 15,
        sharpness: float = 80.0,
    ) -> torch.Tensor:
        """[h, w] float64 disparity in px of the left image's pixels.

        Looked at are `lowest` to `highest` in quarters, over blocks of side `block_px`, odd;
        `sharpness` is that of the soft argmax, per unit of correlation.
        """
        offset = self.pair.left.window.left - self.pair.right.window.left
        cost = correlations(left, right, offset, lowest, highest, block_px)
        return lowest + soft_argmax(cost, sharpness) / STEPS

    def depth_m(self, disparity: torch.Tensor, settings: Settings) -> torch.Tensor:
        """Metres along the optical axis: f b / disparity, by the numbers in `settings`."""
        return settings["focal_px"] * settings["baseline_m"] / disparity


def exposed(
    radiance: torch.Tensor,
    settings: Settings,
    noise: torch.Generator | None,
    whole: bool = True,
    even: torch.Tensor | None = None,
    max_exposure: float | None = None,
) -> torch.Tensor:
    """[h, w] grey values of `radiance`, of which `even` [h, w] has no speckle; see `Twin.grey`.

    Gain above `max_exposure` amplifies the noise, too; None: all of the gain is exposure.
    """
    contrast = settings["infrared.speckle_contrast"]
    if noise is not None and float(contrast.detach()) > 0:
        grains = _gamma_like(radiance, contrast, noise)
        radiance = radiance * grains if even is None else even + (radiance - even) * grains
    image = blurred(radiance, settings["infrared.psf_px"])
    per_grey = settings["infrared.electrons_at_white"] / 255
    if max_exposure is not None:
        per_grey = per_grey / (settings["gain"] / max_exposure).clamp_min(1)
    electrons = image * settings["gain"] * per_grey
    if noise is None:
        return (electrons / per_grey).clamp(0, 255)
    variance = electrons.clamp_min(0) + settings["infrared.read_noise_e"] ** 2
    spread = torch.sqrt(variance + 1e-9)  # the root of 0 has no gradient
    drawn = torch.randn(electrons.shape, generator=noise, dtype=electrons.dtype)
    grey = ((electrons + spread * drawn) / per_grey).clamp(0, 255)
    return grey + (grey.round() - grey).detach() if whole else grey


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


def correlations(
    left: torch.Tensor,
    right: torch.Tensor,
    offset: int,
    lowest: int,
    highest: int,
    block_px: int,
) -> torch.Tensor:
    """[D, h, w] normalised correlation of blocks, -1..1, in steps of 1 / `STEPS` px.

    Column u of `left` is column u + offset - d of `right`; what is outside is dark, and between two
    pixels is the cubic through four (Catmull and Rom).
    """
    width = left.shape[1]
    begin = offset - highest - 1  # a pixel more on both sides for the cubics
    before = max(0, -begin)
    after = max(0, begin + width + highest - lowest + 4 - right.shape[1])
    wide = F.pad(right, (before, after))[:, max(0, begin) :]
    half = block_px // 2
    cubics = [_catmull_rom(step / STEPS) for step in range(STEPS)]

    def mean(image: torch.Tensor) -> torch.Tensor:
        padded = F.pad(image[None], (half, half, half, half), mode="reflect")
        return F.avg_pool2d(padded, block_px, stride=1)[0]

    mean_left = mean(left)
    spread_left = mean(left * left) - mean_left**2
    found = []
    for quarter in range((highest - lowest) * STEPS + 1):
        # A larger disparity lies farther left: d = low + part is between low and low + 1.
        low, part = lowest + quarter // STEPS, quarter % STEPS
        at = highest - low + 1
        around = [wide[:, at + 1 - i : at + 1 - i + width] for i in range(4)]
        other = around[1]
        if part:
            other = torch.stack([w * one for w, one in zip(cubics[part], around, strict=True)])
            other = other.sum(dim=0)
        mean_other = mean(other)
        spread = spread_left * (mean(other * other) - mean_other**2)
        shared = mean(left * other) - mean_left * mean_other
        found.append(shared / torch.sqrt(spread.clamp_min(1e-6)))
    return torch.stack(found)


def _catmull_rom(t: float) -> tuple[float, float, float, float]:
    """Weights of four neighbours for a place `t` from the second to the third."""
    return (
        (-t + 2 * t**2 - t**3) / 2,
        (2 - 5 * t**2 + 3 * t**3) / 2,
        (t + 4 * t**2 - 3 * t**3) / 2,
        (-(t**2) + t**3) / 2,
    )


def soft_argmax(score: torch.Tensor, sharpness: float) -> torch.Tensor:
    """[h, w] mean place of [D, h, w] scores, weighed by exp(sharpness x score) near the best.

    The best is chosen without a gradient.
    """
    count = len(score)
    place = torch.arange(count, dtype=score.dtype)[:, None, None]
    best = score.detach().argmax(dim=0).clamp(_NEAR, count - 1 - _NEAR)
    near = (place - best).abs() <= _NEAR
    weight = torch.softmax(torch.where(near, sharpness * score, -torch.inf), dim=0)
    return (weight * place).sum(dim=0)
