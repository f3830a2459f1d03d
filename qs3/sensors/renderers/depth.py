"""A depth image in place of meshes: the renderer behind `qs3.sense`.

Its pixels are joined to a surface that ends where the depth steps. What lies behind an edge was
never seen: where another camera looks there, the surface behind goes on as it was. The light is
that of `renderers.base`: pattern, shadow, cosine and distance of the projector, and even light.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from qs3.geometry.cameras import Camera
from qs3.sensors.renderers.base import Image, Projector, Scene, incidence, tangents

_SAME = 0.01  # part of 1 / Z by which a surface may bend between two pixels; more is a step


@dataclass(eq=False)
class DepthRenderer:
    """A `Renderer` of what one camera saw; the bodies of scenes are not looked at.

    Cameras and projectors must look as that camera does, from places along its x axis.

    Attributes:
        depth_m: [h, w] metres along the optical axis; 0, NaN or inf where nothing is.
        lens: fx, fy, cx, cy in pixels, the centre of the top left one at (0, 0).
        albedo: 0..1, or an image [h, w] of it.
        rays_per_tangent: how finely cameras sample along their rows; three times a camera's focal
            length in pixels is 3 x 2 samples for each of them.
        world_from_camera: [4, 4].
    """

    depth_m: np.ndarray
    lens: tuple[float, float, float, float]
    albedo: float | np.ndarray = 0.8
    rays_per_tangent: float = 2000.0
    world_from_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    even: bool = True  # samples are spread evenly, so that their mean is the pixel's centre
    _albedos: dict = field(default_factory=dict, repr=False)

    @cached_property
    def _surface(self) -> tuple[np.ndarray, ...]:
        depth = np.asarray(self.depth_m, dtype=np.float32)
        there = np.isfinite(depth) & (depth > 0)
        w = np.where(there, 1 / np.where(there, depth, 1), 0).astype(np.float32)
        linked, slope_x = _along(w)
        _, slope_y = _along(np.ascontiguousarray(w.T))
        return w, linked, slope_x, np.ascontiguousarray(slope_y.T)

    @cached_property
    def _albedo(self) -> np.ndarray:
        # A black surface has a little light, too: whether any comes is what shadow is known by.
        shape = self._surface[0].shape
        return np.maximum(np.broadcast_to(np.float32(self.albedo), shape), np.float32(1e-3))

    def render(
        self, scene: Scene, cameras: list[Camera], *, seed: int, geometry: list[bool]
    ) -> list[Image]:
        """See `Renderer.render`; nothing is drawn at random, so that `seed` has no influence."""
        images = []
        for camera, wanted in zip(cameras, geometry, strict=True):
            light, albedo = self._seen(scene.projector, camera)
            strength = scene.projector.strength if scene.projector else 0.0
            radiance = light * np.float32(strength) + albedo * np.float32(scene.ambient)
            image = Image.without_geometry(radiance)
            images.append(self._with_geometry(radiance, camera) if wanted else image)
        return images

    def provenance(self) -> dict[str, str]:
        """See `Renderer.provenance`."""
        return {"renderer": "depth"}

    def _place(self, world_from_other: np.ndarray) -> float:
        """How far along x another camera or projector is, in metres."""
        moved = np.linalg.inv(self.world_from_camera) @ world_from_other
        ahead = np.eye(4)
        ahead[0, 3] = moved[0, 3]
        assert np.allclose(moved, ahead, atol=1e-6), "a depth image is seen from along its rows"
        return round(float(moved[0, 3]), 9)  # a rotation and its inverse are not quite none

    def _seen(self, projector: Projector | None, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Light [h, w] float32 of the projector at strength 1, and albedo, 0 where nothing is."""
        from qs3.sensors.renderers.depth_kernels import shade

        moved, lamp = self._place(camera.world_from_camera), 0.0
        k, window, _ = key = camera.intrinsics, camera.rendered, moved
        if projector is None and key in self._albedos:
            return self._albedos[key] * 0, self._albedos[key]
        slide, scale = np.zeros((0, 0), dtype=np.float32), 0.0
        if projector is not None:
            lamp, slide = self._place(projector.world_from_projector), projector.slide
            scale = slide.shape[1] / (2 * projector.tan_half_width)
        light, albedo = np.empty((2, window.height, window.width), dtype=np.float32)
        samples = max(1, round(self.rays_per_tangent / k.focal_px))
        surface = (*self._surface, self._albedo, self._facing(lamp))
        view = (k.focal_px, k.cx_px, k.cy_px, float(window.left), float(window.top), moved)
        shade(surface, self.lens, view, samples, slide, scale, lamp, light, albedo)
        self._albedos[key] = albedo
        return light, albedo

    def _facing(self, lamp: float) -> np.ndarray:
        """Albedo, cosine of incidence and distance of a lamp, multiplied, [h, w] float32.

        A plane w = a x + b y + c has the normal n = (a, b, c), and n . P = 1 for its points P, so
        n . (P - lamp) = 1 - a lamp.
        """
        w, _, slope_x, slope_y = self._surface
        fx, fy, cx, cy = (np.float32(value) for value in self.lens)
        x = (np.arange(w.shape[1], dtype=np.float32) - cx) / fx
        y = ((np.arange(w.shape[0], dtype=np.float32) - cy) / fy)[:, None]
        a, b = slope_x * fx, slope_y * fy
        c = w - a * x - b * y
        length = np.sqrt(np.maximum(a * a + b * b + c * c, np.float32(1e-12)))
        return self._albedo * np.maximum(1 - a * np.float32(lamp), 0) / length

    def _with_geometry(self, radiance: np.ndarray, camera: Camera) -> Image:
        """The image with what the centres of its pixels see: planes, one for each of ours."""
        assert self._place(camera.world_from_camera) == 0, "no true depth from elsewhere"
        w, _, slope_x, slope_y = self._surface
        fx, fy, cx, cy = self.lens
        x, y = tangents(camera)
        u, v = fx * x + cx, fy * y + cy
        i, r = np.floor(u + 0.5).astype(int), np.floor(v + 0.5).astype(int)
        beside, below = (u - i).astype(np.float32), (v - r).astype(np.float32)

        def there(image: np.ndarray) -> np.ndarray:
            return image.take(r[:, 0], axis=0, mode="clip").take(i, axis=1, mode="clip")

        a, b, here = there(slope_x), there(slope_y), there(w)
        hit = (here > 0) & (r >= 0) & (r < len(w)) & (i >= 0) & (i < w.shape[1])
        here += a * beside + b * below
        depth = np.where(hit, 1 / np.where(hit, here, 1), np.float32(np.inf))
        a, b = a * np.float32(fx), b * np.float32(fy)
        c = here - a * x.astype(np.float32) - b * y.astype(np.float32)
        length = np.sqrt(np.maximum(a * a + b * b + c * c, np.float32(1e-12)))
        cosine = incidence(np.stack([a / length, b / length, c / length], axis=-1), hit, camera)
        return Image(radiance, depth, hit.astype(np.uint8), cosine)


def _along(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a surface goes on to the next pixel of a row, and how 1 / Z changes a pixel on it.

    What goes on as it did on either side is one surface, however steep.
    """
    step = np.where((w[:, :-1] > 0) & (w[:, 1:] > 0), np.diff(w, axis=1), np.float32(np.nan))
    wide = np.pad(step, ((0, 0), (1, 1)), constant_values=np.nan)
    bend = np.fmin(np.abs(step - wide[:, :-2]), np.abs(step - wide[:, 2:]))
    bend = np.fmin(bend, np.abs(step))  # the smallest that is not NaN
    linked = np.zeros(w.shape, dtype=np.bool_)
    linked[:, :-1] = bend <= _SAME * np.maximum(w[:, :-1], w[:, 1:])
    steps, count = np.zeros_like(w), linked.astype(np.float32)
    steps[:, :-1] = np.where(linked[:, :-1], step, 0)
    steps[:, 1:] += steps[:, :-1].copy()
    count[:, 1:] += linked[:, :-1]
    return linked, steps / np.maximum(count, 1)
