"""A stereo preset's light, lens and noise from a camera's own infrared pictures, by gradient.

The dots of a real projector are not ours, so pictures are compared by what does not depend on where
dots lie (`statistics`): the twin's picture of a plane at the pictures' distance is made like them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.autograd.forward_ad as forward_ad
from scipy.optimize import least_squares

from qs3.calibration.fit.infrared_noise import OverTime, Speckled, noise_residuals, over_time
from qs3.calibration.fit.infrared_statistics import SMOOTH_PX, inner, smooth, statistics
from qs3.config.checks import check_float
from qs3.errors import ConfigError, DataError
from qs3.geometry.cameras import Window
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.gradients.twin import Twin, blurred, settings_of
from qs3.sensors.gradients.views import Pair, View
from qs3.sensors.matching.texture import for_picture
from qs3.sensors.optics.infrared import GreyNoise, InfraredCamera

_SIDE_PX = 480  # of the plane that the twin shows
_FAR = 5.0  # the search ends at factors of e to this power
_TEXTURE_ERROR = 0.02  # of what two pictures of other dots differ by
_CLIPPED = 0.01
_DOTS = 2.0  # variance by the choice of dots over the pictures' own: the twin has as many
_PRIOR = 1.5  # standard deviation of a number's logarithm before any picture is seen
UNKNOWN = 0.2  # a number that is less sure than this share is said to be unknown
WITHIN = 0.05  # what is promised of the others, at two standard errors; or they are called rough

KEYS = (
    "ambient", "infrared.psf_px", "infrared.speckle_contrast", "infrared.electrons_at_white",
    "infrared.read_noise_e",
)  # fmt: skip
NOISE = KEYS[2:]
FOCAL_BASELINE = "f B"


@dataclass(frozen=True, eq=False)
class Pictures:
    """One still scene. Images [h, w], grey values 0..255, rectified.

    Attributes:
        name: for messages.
        left: one or more frames; two or more tell noise from texture.
        right: the same of the other camera, or none.
        off: frames of the left camera with the projector off, at the same exposure; may be empty.
        depth_m: [h, w] of the left camera, NaN where there is none; None: not known.
    """

    name: str
    left: Sequence[np.ndarray]
    right: Sequence[np.ndarray] = ()
    off: Sequence[np.ndarray] = ()
    depth_m: np.ndarray | None = None


@dataclass(frozen=True)
class InfraredFit:
    """What pictures say of a preset.

    Attributes:
        values: by the keys of the sensor's config, `KEYS` and infrared.white_level, the grey value
            at the quantile that the preset's exposure goes by; those that no picture tells are
            the base preset's.
        errors: standard error of each over its value, from the curvature of the fit.
        unknown: keys that the pictures do not tell, with the reason; `FOCAL_BASELINE`, too.
        rough: keys that they tell, but not to within `WITHIN`.
        focal_baseline: f B in px m by disparity and depth; None: not known, `unknown` says why.
        dots_over_ambient: at `distance_m`, as `qs3 bench` has it.
        distance_m: median over the scenes.
        misfit: RMS of what is left, in standard errors; about 1 is good.
        gain: of the pictures' amplifier, as it was given. Electrons at white are without it, and
            read-out noise is what it was at it.
    """

    values: Mapping[str, float]
    errors: Mapping[str, float]
    unknown: Mapping[str, str]
    rough: tuple[str, ...]
    focal_baseline: float | None
    dots_over_ambient: float
    distance_m: float
    misfit: float
    gain: float = 1.0

    @property
    def noise(self) -> GreyNoise:
        """Of the pictures as they are, amplifier included."""
        electrons = self.values["infrared.electrons_at_white"] / self.gain
        return GreyNoise(electrons, self.values["infrared.read_noise_e"])


@dataclass
class _Target:
    """What one scene's pictures say, and how sure that is."""

    distance_m: float
    shared: torch.Tensor
    skewness: torch.Tensor
    noise: OverTime | None  # None: one frame
    white: float  # grey value at the exposure's quantile
    added: torch.Tensor | None  # mean of on - off over mean of off
    clipped: bool  # too many pixels are black or white for the texture to be what it was
    dots: Speckled  # white under the base's projector there
    shading: torch.Tensor  # [h, w] the same without its dots


def fit_pictures(
    scenes: Sequence[Pictures],
    base: SpeckleStereo,
    distance_m: float | None = None,
    gain: float = 1.0,
) -> InfraredFit:
    """Fit ambient light, blur and noise of `base` to pictures; see `InfraredFit`.

    Args:
        scenes: at least one; matt things without much print on them show what dots do.
        base: the preset to begin with: pattern, projector and geometry stay.
        distance_m: of the scenes without a depth image.
        gain: by how much the camera's amplifier raised all pictures, >= 1. Noise does not tell it
            from fewer electrons at white, so it has to be said.

    Raises:
        DataError: pictures are too small, dark, or without dots.
        ConfigError: `gain` is below 1, the base has no linear camera, or a scene's distance is not
            known.
    """
    _camera(base)
    targets = [_target(scene, base, distance_m) for scene in scenes]
    check_float("gain", gain, ">= 1")
    start = {key: _first(key, base) for key in KEYS}
    start["infrared.electrons_at_white"] /= gain  # of grey value 255 as it is in the pictures

    def residuals(logs: Sequence[torch.Tensor]) -> torch.Tensor:
        values = {key: start[key] * torch.exp(log) for key, log in zip(KEYS, logs, strict=True)}
        parts = [_residuals(target, values) for target in targets]
        return torch.cat([*parts, torch.stack(list(logs)) / _PRIOR])

    def at(logs: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return residuals(list(torch.from_numpy(logs))).numpy()

    def slopes(logs: np.ndarray) -> np.ndarray:
        # Forward mode: as many passes as numbers, where backward would take one for each residual.
        at, columns = torch.from_numpy(logs), []
        for i in range(len(KEYS)):
            with forward_ad.dual_level():
                # Only what depends on this number gets a slope, and is computed anew.
                one = forward_ad.make_dual(at[i], torch.ones((), dtype=torch.float64))
                out = residuals([*at[:i], one, *at[i + 1 :]])
                slope = forward_ad.unpack_dual(out).tangent
            columns.append(torch.zeros_like(out) if slope is None else slope)
        return torch.stack(columns, dim=1).detach().numpy()

    solved = least_squares(
        at, np.zeros(len(KEYS)), jac=slopes, bounds=(-_FAR, _FAR), ftol=1e-5, xtol=1e-4
    )
    found = torch.from_numpy(solved.x)
    covariance = torch.linalg.inv(torch.from_numpy(solved.jac.T @ solved.jac))
    rest = torch.from_numpy(solved.fun[: -len(KEYS)])
    scale = max(1.0, float(rest.square().sum() / max(len(rest) - len(KEYS), 1)))
    numbers = {key: start[key] * torch.exp(log) for key, log in zip(KEYS, found, strict=True)}
    tiles = _tile_scatter(targets, numbers, covariance @ torch.from_numpy(solved.jac.T))
    spread = torch.sqrt(torch.maximum(scale * covariance.diagonal(), _DOTS * tiles))
    errors = {key: float(one) for key, one in zip(KEYS, spread, strict=True)}
    unknown = _unknown(errors, covariance, targets)
    values = {
        key: start[key] if key in unknown else start[key] * math.exp(float(log))
        for key, log in zip(KEYS, found, strict=True)
    }
    values["infrared.electrons_at_white"] *= gain
    values["infrared.white_level"] = float(np.median([target.white for target in targets]))
    middle = float(np.median([target.distance_m for target in targets]))
    fit = InfraredFit(
        values,
        errors,
        unknown,
        tuple(key for key in KEYS if key not in unknown and 2 * errors[key] > WITHIN),
        None,
        _dots_over_ambient(base, middle, values),
        middle,
        float(rest.square().mean().sqrt()),
        gain,
    )
    product = _focal_baseline(scenes, base, fit.noise)
    if product is None:
        unknown[FOCAL_BASELINE] = _why_no_product(scenes)
    return replace(fit, focal_baseline=product)


def facing(base: SpeckleStereo, distance_m: float, side_px: int) -> Pair:
    """A white plane that faces a sensor's cameras, a square of pixels in the middle of the view."""
    k = base.intrinsics
    high, wide = min(side_px, k.height_px), min(side_px, k.width_px)
    window = Window((k.width_px - wide) // 2, (k.height_px - high) // 2, wide, high)
    one = torch.ones(high, wide, dtype=torch.float64)
    plane = torch.zeros(high, wide, 3, dtype=torch.float64)
    plane[..., 2] = 1 / distance_m
    view = View(window, plane, one, one, one > 0, one * distance_m)
    return Pair(base, view, view)


def _camera(base: SpeckleStereo) -> InfraredCamera:
    if not isinstance(base.infrared, InfraredCamera):
        raise ConfigError("base= must be a preset with a linear infrared camera")
    return base.infrared


def _first(key: str, base: SpeckleStereo) -> float:
    """Where the search begins: the preset's value, or a small one where that is 0."""
    found: object = base
    for word in key.split("."):
        found = getattr(found, word)
    assert isinstance(found, int | float)
    return float(found) or {"ambient": 0.01, "infrared.psf_px": 0.5}.get(key, 1.0)


def _target(scene: Pictures, base: SpeckleStereo, distance_m: float | None) -> _Target:
    images = [np.asarray(image, dtype=np.float64) for image in scene.left]
    if len({image.shape for image in (*images, *scene.off)}) != 1:
        raise DataError(f"{scene.name}: its pictures have different sizes")
    if min(images[0].shape) < 8 * SMOOTH_PX:
        raise DataError(f"{scene.name}: {images[0].shape} is too small; 100 px are the least")
    if images[0].mean() < 3:
        raise DataError(f"{scene.name}: the picture is black")
    depths = _depths(scene)
    where = float(np.median(depths)) if depths.size else distance_m
    if where is None or not where > 0:
        raise ConfigError(
            f"{scene.name} has no depth image with depths in it: say its distance with "
            "distance=METRES"
        )
    tensors = [torch.from_numpy(image) for image in images]
    each = [statistics(tensor) for tensor in tensors]
    shared = torch.stack([one.shared for one in each]).mean(dim=0)
    if shared[0] <= 0:
        raise DataError(f"{scene.name}: no dots are seen, neighbours are not alike")
    added = None
    if scene.off:
        off = np.mean([np.asarray(image, dtype=np.float64) for image in scene.off], axis=0)
        added = torch.tensor((np.mean(images, axis=0).mean() - off.mean()) / max(off.mean(), 0.1))
    skewness = torch.stack([one.skewness for one in each]).mean()
    white = float(np.quantile(images[0], _camera(base).white_quantile))
    patch = Twin(facing(base, where, _SIDE_PX), fine=3)
    dark = settings_of(patch.pair, 1.0) | {"ambient": torch.zeros((), dtype=torch.float64)}
    projected = patch.radiance(dark)[0]
    contrast = _camera(base).speckle_contrast or 0.2
    drawn = np.random.default_rng(0).gamma(1 / contrast**2, contrast**2, projected.shape)
    grain = torch.from_numpy((drawn - 1) / contrast)
    ends = np.mean([(image <= 0) | (image >= 255) for image in images])
    return _Target(
        where, shared, skewness, over_time(tensors), white, added, bool(ends > _CLIPPED),
        Speckled(projected, grain, _camera(base).ambient_speckles), smooth(projected),
    )  # fmt: skip


def _depths(scene: Pictures) -> np.ndarray:
    """[n] those that are known."""
    depth = np.zeros(0) if scene.depth_m is None else scene.depth_m
    return depth[np.isfinite(depth)]


def _residuals(target: _Target, values: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """What the twin's statistics are off by, in standard errors."""
    ambient, width, contrast, electrons, read = (values[key] for key in KEYS)
    # Light from all sides stays what it is through the lens; only the middle counts.
    fields = target.dots.behind(width)
    picture = target.dots.picture(fields, ambient, contrast)
    parts = []
    if not target.clipped:
        ours, theirs = statistics(picture, ambient + target.shading), target
        parts.append((ours.shared - theirs.shared) / (_TEXTURE_ERROR * theirs.shared[0]))
        third = (ours.skewness - theirs.skewness) / (3 * _TEXTURE_ERROR * theirs.skewness.abs())
        parts.append(third[None])
    if target.added is not None:
        added = inner(picture).mean() / ambient - 1
        parts.append(((added / target.added - 1) / _TEXTURE_ERROR)[None])
    if (noise := target.noise) is not None:
        speckle = target.dots.noise(fields, noise, ambient, contrast)
        parts.append(noise_residuals(noise, speckle, electrons / 255, read))
    return torch.cat([torch.zeros(0, dtype=torch.float64), *parts])


def _tile_scatter(
    targets: Sequence[_Target], values: Mapping[str, torch.Tensor], answer: torch.Tensor
) -> torch.Tensor:
    """[n] variance of the found logarithms between tiles of the pictures: a jackknife.

    One grain lies in several bins of brightness, which the curvature of the fit takes for
    independent. `answer` [n, R] is how the numbers follow the residuals, near the solution.
    """
    total, row = torch.zeros(len(answer), dtype=torch.float64), 0
    for target in targets:
        whole = _residuals(target, values)
        row += len(whole)
        if (noise := target.noise) is None:
            continue
        ambient, width, contrast, electrons, read = (values[key] for key in KEYS)
        speckle = target.dots.noise(target.dots.behind(width), noise, ambient, contrast)
        parts = [
            noise_residuals(noise, speckle, electrons / 255, read, part) for part in noise.parts
        ]
        moved = torch.stack(parts) @ answer[:, row - len(parts[0]) : row].T
        total += (len(parts) - 1) * moved.var(dim=0, correction=0)
    return total


def _unknown(
    errors: Mapping[str, float], covariance: torch.Tensor, targets: Sequence[_Target]
) -> dict[str, str]:
    """Keys that pictures do not tell, and why."""
    out = {}
    electrons, read = KEYS[3], KEYS[4]
    clipped = all(target.clipped for target in targets) and (
        f"over {_CLIPPED:.0%} of the pixels are black or white, which hides texture: expose so "
        "that they are not"
    )
    if all(target.noise is None for target in targets):
        return dict.fromkeys(NOISE, "needs two or more frames of a still scene") | {
            key: clipped or "the pictures hold too few dots"
            for key in KEYS[:2]
            if errors[key] > UNKNOWN
        }
    for key in KEYS:
        if errors[key] > UNKNOWN:
            out[key] = clipped or "its effect on the pictures is smaller than their own scatter"
    if electrons in out and read in out:
        i, j = KEYS.index(electrons), KEYS.index(read)
        shared = float(covariance[i, j] / torch.sqrt(covariance[i, i] * covariance[j, j]))
        if abs(shared) > 0.9:
            why = "cannot be told apart: take frames of dark and of bright surfaces"
            out[electrons] = out[read] = f"{electrons} and {read} {why}"
    return out


def _focal_baseline(
    scenes: Sequence[Pictures], base: SpeckleStereo, noise: GreyNoise
) -> float | None:
    """Median of disparity times depth over the pixels that have both; `noise` of one frame."""
    found = []
    for scene in scenes:
        if scene.depth_m is None or not scene.right:
            continue
        pair = [
            np.clip(np.rint(np.mean(images, axis=0)), 0, 255).astype(np.uint8)
            for images in (scene.left, scene.right)
        ]
        count = len(scene.left)  # their mean has the noise of one with so many times the electrons
        of_mean = GreyNoise(noise.electrons_at_white * count, noise.read_noise_e * count**0.5)
        match = for_picture(base.matcher, of_mean).match(*pair)
        product = match.disparity * scene.depth_m
        found.append(product[np.isfinite(product)])
    every = np.concatenate(found) if found else np.zeros(0)
    return float(np.median(every)) if every.size else None


def _why_no_product(scenes: Sequence[Pictures]) -> str:
    """What is missing for f B."""
    if not any(scene.right for scene in scenes):
        return (
            "one camera's pictures show no disparity: it needs SCENE_right.png, and a depth image"
        )
    if not any(_depths(scene).size for scene in scenes if scene.right):
        return "a scene with right pictures needs a depth image, too, SCENE_depth.png"
    return "no pixel has both a disparity by the base's matcher and a depth"


def _dots_over_ambient(
    base: SpeckleStereo, distance_m: float, values: Mapping[str, float]
) -> float:
    """The brightest percent of the projector's light over the ambient light."""
    patch = Twin(facing(base, distance_m, _SIDE_PX), fine=3)
    dark = settings_of(patch.pair, 1.0) | {"ambient": torch.zeros((), dtype=torch.float64)}
    width = torch.tensor(values["infrared.psf_px"], dtype=torch.float64)
    added = inner(blurred(patch.radiance(dark)[0], width))
    return float(torch.quantile(added.flatten(), 0.99)) / values["ambient"]
