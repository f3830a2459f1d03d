"""What each camera sees, as a plane for every pixel: the constants of the differentiable twin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from qs3.errors import ConfigError
from qs3.geometry.cameras import Camera, Window
from qs3.sensors.base import window_of
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.renderers.base import Body, Image, Projector, Renderer, Scene, tangents

_BEND = 1e-3  # of 1 / Z, second difference over neighbours: more is an edge


@dataclass(frozen=True)
class View:
    """One camera's pixels. Tensors [h, w] float64 unless said otherwise.

    Attributes:
        window: which pixels of the whole image.
        plane: [h, w, 3] (a, b, c) of the surface: 1 / Z = a x + b y + c with x, y the tangents
            of a ray; in the camera's axes and metres; 0 where nothing is.
        albedo: mean over the pixel; 0 where nothing is.
        lit: share of the pixel that the projector reaches.
        smooth: bool; the surface goes on in all four directions, so it is no silhouette.
        depth_m: at the pixels' centres, inf where nothing is.
    """

    window: Window
    plane: torch.Tensor
    albedo: torch.Tensor
    lit: torch.Tensor
    smooth: torch.Tensor
    depth_m: torch.Tensor


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
    samples_seed: int = 0,
) -> Pair:
    """Render what the twin of a sensor needs of a scene of matt bodies.

    Args:
        sensor: its cameras and projector; its light and exposure do not matter here.
        bodies: the scene; matt, as the twin is.
        box_m: [2, 3] of the world: only the pixels that it covers are rendered.
        world_from_camera: [4, 4] pose of the left camera.
        renderer: gives geometry, albedo and shadows.
        samples_seed: of the renderer's sampling.

    Raises:
        ConfigError: a body is glossy, or the box is out of one camera's view.
    """
    if any(body.gloss is not None for body in bodies):
        raise ConfigError("the differentiable twin knows matt bodies only: leave materials= out")
    k = sensor.intrinsics
    whole = Camera(k, world_from_camera)
    views = []
    centre = whole.moved((sensor.baseline_m / 2, 0, 0)).world_from_camera
    white = Projector(centre, np.ones((4, 4), np.float32), 10.0, strength=1.0)
    for shift in (0.0, sensor.baseline_m):
        camera = whole.moved((shift, 0, 0))
        window = window_of(box_m, camera, margin_px=sensor.margin_px)
        if window is None:
            raise ConfigError("the box is outside the view of one of the cameras")
        camera = replace(camera, window=window)
        (even,) = renderer.render(
            Scene(bodies, None, 1.0), [camera], seed=samples_seed, geometry=[True]
        )
        (lit,) = renderer.render(
            Scene(bodies, white), [camera], seed=samples_seed, geometry=[False]
        )
        projector_x = sensor.baseline_m / 2 - shift
        views.append(_view(camera, even, lit.radiance, projector_x))
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
    tensors = (plane, albedo, share, smooth, np.where(there, 1 / inverse, np.inf))
    return View(camera.rendered, *(torch.from_numpy(np.ascontiguousarray(t)) for t in tensors))


def _shifted(image: np.ndarray, axis: int, step: int) -> np.ndarray:
    """The neighbour before (step 1) or after (-1) along an axis; NaN outside."""
    out = np.roll(image, step, axis=axis)
    edge: list[slice | int] = [slice(None), slice(None)]
    edge[axis] = 0 if step > 0 else -1
    out[tuple(edge)] = np.nan
    return out
