"""Objects before a sensor whose numbers change: what both cameras see is rendered once.

Light of the projector and light from all sides reach a pixel in parts that the tuned numbers only
scale, so for the twin each part is rendered once; the rest is `qs3.sensors.gradients`. A cloud of
the twin has no holes and no filters, and its matcher correlates whatever the sensor's does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from qs3.errors import ConfigError, DataError
from qs3.generation.recipes import BoxCrop, Mesh2Point
from qs3.generation.scenes import Alone
from qs3.geometry.sampling import farthest_point_sampling_np
from qs3.meshes.mesh import Mesh
from qs3.sensors.base import on_grid
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.sensors.gradients.twin import STEPS, Twin, correlations, exposed, settings_of, soft_argmax
from qs3.sensors.gradients.views import Pair, pair_of
from qs3.sensors.optics.infrared import InfraredCamera
from qs3.sensors.renderers.base import Renderer
from qs3.tuning.parameters import check_sensor, values_of, with_values
from qs3.utils.plural import counted
from qs3.utils.seeding import derive, object_rng

_AROUND_PX = 3  # disparities beyond those of the object that are looked at
_SHARPNESS = 80.0
_FEWEST = 64  # points of a cloud


@dataclass(frozen=True, eq=False)
class View:
    """One pose. Images [h, w] float32 over the windows of the left and the right camera.

    Attributes:
        even: radiance in light from all sides of strength 1.
        projected: radiance in the sensor's own projector's light.
        offset: first column of the left window less that of the right one.
        seen: [r, c] bool of the samples: something is there.
        rays: [r, c, 3] of the samples, in the world, for a depth of 1.
        origin_m: [3] of the camera in the world, as it is believed.
        grid: first row, first column and step of the samples in the left window.
        lowest, highest: whole disparities that are looked at.
    """

    even: tuple[Tensor, Tensor]
    projected: tuple[Tensor, Tensor]
    offset: int
    seen: Tensor
    rays: Tensor
    origin_m: Tensor
    grid: tuple[int, int, int]
    lowest: int
    highest: int


@dataclass(frozen=True, eq=False)
class Still:
    """An object's views, for clouds by any numbers of the sensor.

    Attributes:
        id: of the object.
        recipe: with the sensor whose other numbers stay.
        mesh, seed, renderer: what `Mesh2Point.make` takes.
        views: of those poses whose windows hold it.
        box_m: [2, 3] by which clouds are cut.
    """

    id: str
    recipe: Mesh2Point
    mesh: Mesh
    seed: int
    renderer: Renderer
    views: tuple[View, ...]
    box_m: np.ndarray

    def cloud(self, values: Mapping[str, Tensor], points: int, seed: int) -> Float[Tensor, "n 3"]:
        """[points, 3] float64 in the unit ball, with gradients by `values`.

        Args:
            values: by `parameters.BOUNDS`; the others are the sensor's.
            points: wanted, by farthest point sampling; fewer repeat.
            seed: of all noise, which is the same for all values.

        Raises:
            DataError: next to nothing is in the box.
        """
        parts = []
        for i, view in enumerate(self.views):
            noise = torch.Generator().manual_seed(derive(seed, self.id, i) % 2**63)
            parts.append(_points(view, check_sensor(self.recipe.sensor), values, noise))
        every = torch.cat(parts) if parts else torch.zeros(0, 3, dtype=torch.float64)
        place = every.detach().numpy()
        every = every[torch.from_numpy(self.recipe.crop.inside(place, self.box_m))]
        if len(every) < _FEWEST:
            found = counted(len(every), "point is", "points are")
            raise DataError(f"{self.id}: of the twin {found} in its box")
        order = farthest_point_sampling_np(every.detach().numpy().astype(np.float32), points)
        return in_unit_ball(every[torch.from_numpy(order)])

    def measured(self, values: Mapping[str, float], points: int) -> Float[Tensor, "n 3"]:
        """[points, 3] float64 in the unit ball, by the ordinary sensor, as it is generated.

        Raises:
            TooFewPointsError: see `Mesh2Point`.
        """
        sensor = with_values(check_sensor(self.recipe.sensor), values)
        recipe = replace(self.recipe, sensor=sensor, clean=False)
        made = recipe.make(self.mesh, self.id, self.seed, self.renderer)
        return sampled(made.arrays["points"], points)


def in_unit_ball(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """About the centroid, the farthest at 1."""
    centred = points - points.mean(dim=0)
    return centred / centred.norm(dim=1).max().clamp_min(1e-9)


def check_recipe(recipe: object) -> Mesh2Point:
    """The recipe; ConfigError if the twin cannot follow it."""
    if not isinstance(recipe, Mesh2Point):
        raise ConfigError("only domains of Mesh2Point can be tuned: take domain=specklenet10")
    check_sensor(recipe.sensor)
    left_out = {
        "materials": recipe.materials is not None,
        "light": recipe.light is not None,
        "depth_errors": recipe.depth_errors is not None,
        "scene": not isinstance(recipe.scene, Alone),
        "crop": type(recipe.crop) is not BoxCrop,
    }
    if wrong := [key for key, set_ in left_out.items() if set_]:
        raise ConfigError(
            f"the differentiable twin knows matt objects alone in the dark, cut by their box: "
            f"leave {wrong[0]}= out"
        )
    return recipe


def still_of(
    recipe: Mesh2Point, mesh: Mesh, object_id: str, seed: int, renderer: Renderer
) -> Still:
    """Render an object from where `Mesh2Point.make` looks at it, with the same random numbers."""
    sensor = check_sensor(recipe.sensor)
    rng = object_rng(seed, object_id, 0)
    placed = recipe.placing.place(mesh, rng, object_id)
    box = placed.bounds
    pose_rng = object_rng(seed, object_id, 1)
    poses = recipe.views.poses(pose_rng, box, object_id)
    bodies = recipe.scene.bodies(placed, np.stack(poses)[:, :3, 3], rng)
    believed = recipe.drift.believed(poses, pose_rng)
    views = []
    for i, (pose, taken_for) in enumerate(zip(poses, believed, strict=True)):
        drawn = int(object_rng(seed, object_id, 2 + i).integers(2**31))
        try:
            pair = pair_of(sensor, bodies, box, pose, renderer, drawn)
        except ConfigError:
            continue  # outside the picture: the sensor gives nothing there, too
        views.append(_view(pair, np.asarray(taken_for)))
    return Still(object_id, recipe, mesh, seed, renderer, tuple(views), box)


def _view(pair: Pair, believed: np.ndarray) -> View:
    sensor, window = pair.sensor, pair.left.window
    settings = settings_of(pair, 1.0)
    dark = settings | {"ambient": torch.zeros((), dtype=torch.float64)}
    with torch.no_grad():
        projected = Twin(pair).radiance(dark)
    step, k = sensor.step_px, sensor.intrinsics
    left, _ = on_grid(window.left, window.width, step, sensor.sample_offset_px)
    top, _ = on_grid(window.top, window.height, step, sensor.sample_offset_px)
    grid = (top - window.top, left - window.left, step)
    depth = pair.left.depth_m[grid[0] :: step, grid[1] :: step]
    rows, columns = depth.shape
    x = (left + torch.arange(columns, dtype=torch.float64) * step - k.cx_px) / k.focal_px
    y = (top + torch.arange(rows, dtype=torch.float64) * step - k.cy_px) / k.focal_px
    ray = torch.stack(
        [x.expand(rows, -1), y[:, None].expand(-1, columns), torch.ones_like(depth)], dim=-1
    )
    pose = torch.from_numpy(believed.astype(np.float64))
    seen = torch.isfinite(depth)
    true = sensor.focal_px * sensor.baseline_m / depth[seen]
    low, high = (float(true.min()), float(true.max())) if len(true) else (1.0, 2.0)
    return View(
        (pair.left.albedo.float(), pair.right.albedo.float()),
        (projected[0].float(), projected[1].float()),
        window.left - pair.right.window.left,
        seen,
        ray @ pose[:3, :3].T,
        pose[:3, 3],
        grid,
        max(0, math.floor(low) - _AROUND_PX),
        math.ceil(high) + _AROUND_PX,
    )


def _points(
    view: View, sensor: SpeckleStereo, values: Mapping[str, Tensor], noise: torch.Generator
) -> Float[Tensor, "m 3"]:
    """In the world, of every sample that sees something."""
    known = values_of(sensor, ("ambient", *(f"infrared.{name}" for name in _CAMERA)))
    every = {k: torch.tensor(v, dtype=torch.float64) for k, v in known.items()} | dict(values)
    camera = sensor.infrared
    radiance = [
        every["ambient"] * even.double() + lit.double()
        for even, lit in zip(view.even, view.projected, strict=True)
    ]
    lit = radiance[0][view.even[0] > 0]
    if len(lit) == 0:
        return torch.zeros(0, 3, dtype=torch.float64)
    assert isinstance(camera, InfraredCamera)  # `check_sensor`
    longest = camera.max_exposure
    if camera.fixed_gain is None:
        # torch.quantile takes 16 million values at most; a window has fewer.
        gain = every["infrared.white_level"] / torch.quantile(lit, camera.white_quantile)
        if longest is not None:
            gain = gain.clamp(max=longest * camera.max_gain)
    else:
        gain = torch.tensor(camera.fixed_gain, dtype=torch.float64)
    grey = [
        exposed(
            image,
            every | {"gain": gain},
            noise,
            even=None if camera.ambient_speckles else every["ambient"] * even.double(),
            max_exposure=longest,
        )
        for image, even in zip(radiance, view.even, strict=True)
    ]
    block = getattr(sensor.matcher, "block_size", 15)
    score = correlations(grey[0], grey[1], view.offset, view.lowest, view.highest, block, view.grid)
    disparity = view.lowest + soft_argmax(score, _SHARPNESS) / STEPS
    if steps := sensor.steps_per_px:  # gradients pass as if there were none
        disparity = disparity + ((disparity * steps).round() / steps - disparity).detach()
    depth = sensor.focal_px * sensor.baseline_m / disparity.clamp_min(0.1)
    return (view.rays * depth[..., None] + view.origin_m)[view.seen]


_CAMERA = ("psf_px", "electrons_at_white", "read_noise_e", "speckle_contrast", "white_level")


def sampled(cloud: Float[np.ndarray, "m 3"], points: int) -> Float[Tensor, "n 3"]:
    """[points, 3] float64 of a stored cloud, which is in the order of farthest point sampling."""
    order = farthest_point_sampling_np(np.asarray(cloud), points)
    return in_unit_ball(torch.from_numpy(np.asarray(cloud, dtype=np.float64)[order]))
